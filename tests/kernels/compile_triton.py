"""Compiles the Triton kernels of the hash grid for a compute capability, such as 80 or 90. No GPU is needed."""

from __future__ import annotations

import sys

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from enerf_ns.kernels import hash_grid_triton

for kernel in (hash_grid_triton._forward, hash_grid_triton._backward_table, hash_grid_triton._backward_x):
    constants = {"FEATURES": 2, "BLOCK": hash_grid_triton.BLOCK}
    pointers = ("x", "table", "scalings", "encoding", "grad_encoding", "grad_table", "grad_x")
    types = {
        name: "constexpr" if name in constants else "*fp32" if name in pointers else "i32" for name in kernel.arg_names
    }
    made = triton.compile(ASTSource(kernel, types, constants), target=GPUTarget("cuda", int(sys.argv[1]), 32))
    assert len(made.asm["cubin"]) > 0
    print(kernel.__name__)
