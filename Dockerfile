# univoxel on a CPU: docker build -t univoxel . && docker run --rm -v "$PWD:/data" univoxel train mug
# Untried: no daemon was there. Its commands are those of `make wheel-test`, which was run.
# TORCH_INDEX: PyTorch's index of builds for CPUs; its page "Get started" has the address. Without
# it comes a build for CUDA, of several gigabytes.
FROM python:3.12-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ libglm-dev libembree-dev libtbb-dev \
    && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps -w /wheels /source

FROM python:3.12-slim-bookworm
ARG TORCH_INDEX
RUN apt-get update && apt-get install -y --no-install-recommends libembree3-3 libgomp1 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} torch \
    && pip install --no-cache-dir /wheels/*.whl \
    && rm -rf /wheels \
    && useradd --create-home user
USER user
WORKDIR /data
ENTRYPOINT ["univoxel"]
CMD ["--help"]
