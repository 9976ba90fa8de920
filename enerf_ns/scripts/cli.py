"""The `enerf` command."""

from __future__ import annotations

import sys
import warnings
from typing import Annotated, Union  # tyro reads these annotations on Python 3.10

import tyro

from enerf_ns.dataparsers.errors import UserError
from enerf_ns.scripts.bench import Bench
from enerf_ns.scripts.check_numerics import CheckNumerics
from enerf_ns.scripts.convert import Convert
from enerf_ns.scripts.demo import Demo
from enerf_ns.scripts.inspect import Inspect
from enerf_ns.scripts.reconstruct import Reconstruct
from enerf_ns.scripts.report import Report
from enerf_ns.scripts.simulate import Simulate

Command = Union[  # noqa: UP007
    Annotated[Bench, tyro.conf.subcommand(name="bench")],
    Annotated[CheckNumerics, tyro.conf.subcommand(name="check-numerics")],
    Annotated[Convert, tyro.conf.subcommand(name="convert")],
    Annotated[Demo, tyro.conf.subcommand(name="demo")],
    Annotated[Inspect, tyro.conf.subcommand(name="inspect")],
    Annotated[Reconstruct, tyro.conf.subcommand(name="reconstruct")],
    Annotated[Report, tyro.conf.subcommand(name="report")],
    Annotated[Simulate, tyro.conf.subcommand(name="simulate")],
]


def entrypoint() -> None:
    """Run the command line; a user's mistake ends it with one sentence."""
    warnings.filterwarnings("ignore", module="nerfstudio")
    try:
        tyro.cli(Command, description="Radiance fields from event cameras.").main()
    except UserError as error:
        raise SystemExit(f"enerf: {error}") from error
    except MemoryError as error:
        raise SystemExit("enerf: There is not enough memory for this; ask for less at a time.") from error
    except KeyboardInterrupt as error:
        print("enerf: Stopped.", file=sys.stderr)
        raise SystemExit(130) from error
