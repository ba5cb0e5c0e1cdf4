# An image with evetac, for users without a Python of their own; docs/install.md explains how to use it.
FROM python:3.11-slim

# torch has its own layer, first, because it is the largest and changes least. The CPU build saves gigabytes over CUDA.
COPY constraints.txt /opt/evetac/
RUN pip install --no-cache-dir --constraint /opt/evetac/constraints.txt \
    --extra-index-url https://download.pytorch.org/whl/cpu torch

COPY . /opt/evetac/
RUN pip install --no-cache-dir --constraint /opt/evetac/constraints.txt '/opt/evetac[convert,plot]'

# Compiled kernels are stored next to their source and, like it, belong to root, so that no user can change code that
# others run. `docker run --user` accepts any number; each user gets a copy of the kernels (evetac_cli/kernels/kernel_cache.py).
RUN evetac doctor compile
RUN useradd --create-home evetac && mkdir --mode=1777 /data
USER evetac

WORKDIR /data
ENTRYPOINT ["evetac"]
