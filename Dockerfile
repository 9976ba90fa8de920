# An image with the package, its readers and Nerfstudio's tools:
#
#     docker build -t enerf-ns .
#     docker run --rm -v "$PWD:/data" enerf-ns enerf demo --output-dir demo
#     docker run --rm --gpus all -p 7007:7007 -v "$PWD:/data" enerf-ns ns-train enerf --data recording
#
# Its PyTorch has CUDA, and also runs on a CPU.
FROM python:3.11-slim-bookworm

# Two packages below Nerfstudio are compiled; Open3D, which ns-export imports, needs the libraries.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        build-essential git libusb-1.0-0 libgl1 libx11-6 libgomp1 libegl1 \
    && rm -rf /var/lib/apt/lists/*

ENV PIP_NO_CACHE_DIR=1 PIP_CONSTRAINT=/opt/enerf-ns/constraints.txt
WORKDIR /opt/enerf-ns
COPY constraints.txt pyproject.toml README.md LICENSE ./
COPY enerf_ns enerf_ns
COPY dataparsers dataparsers
# Nerfstudio brings opencv-python-headless, which owns the same folder cv2/: the package with more in it comes last.
RUN pip install '.[bag,event-files]' \
    && pip install --no-deps --force-reinstall opencv-contrib-python-headless

WORKDIR /data
EXPOSE 7007
CMD ["enerf", "--help"]
