# evetac for those who want no Python of their own; docs/install.md says how to use it. `scripts/try_dockerfile.py`
# follows these lines where there is no Docker.
FROM python:3.11-slim

# torch alone and first: it is the largest and changes least. The build for CPUs: that for CUDA is gigabytes larger.
COPY constraints.txt /opt/evetac/
RUN pip install --no-cache-dir --constraint /opt/evetac/constraints.txt \
    --extra-index-url https://download.pytorch.org/whl/cpu torch

COPY . /opt/evetac/
RUN pip install --no-cache-dir --constraint /opt/evetac/constraints.txt '/opt/evetac[convert,plot]'

# Compiled kernels lie beside their source and are root's, as the source is: nobody may write what others load and run.
# `docker run --user` takes any number: each user gets a copy (evetac_cli/kernel_cache.py).
RUN evetac doctor --compile
RUN useradd --create-home evetac && mkdir --mode=1777 /data
USER evetac

WORKDIR /data
ENTRYPOINT ["evetac"]
