# univoxel on a CPU:
#     docker build -t univoxel --build-arg TORCH_INDEX=ADDRESS .
#     docker run --rm -v "$PWD:/data" univoxel train mug --out run
# Never built: no daemon was there. hadolint reads it, and its commands are those of `make
# wheel-test`, which was run. The Python packages take 1.2 GB with the builds of PyTorch for CPUs.
# TORCH_INDEX: PyTorch's index of those; its page "Get started" has the address. Without it comes a
# build for CUDA, of several gigabytes.
# The container's user has the number 1000. If yours is another: docker run --user "$(id -u)"
FROM python:3.12-slim-bookworm AS build
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends g++ libglm-dev libembree-dev libtbb-dev \
    && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps -w /wheels /source

FROM python:3.12-slim-bookworm
ARG TORCH_INDEX
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends libembree3-3 libgomp1 \
    && rm -rf /var/lib/apt/lists/*
# The version that was tested
COPY constraints.txt /
# Bound, not copied: no layer keeps the wheel
# hadolint ignore=DL3013
RUN --mount=type=bind,from=build,source=/wheels,target=/wheels \
    pip install --no-cache-dir -c /constraints.txt ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} torch \
    && pip install --no-cache-dir -c /constraints.txt /wheels/*.whl \
    && useradd --uid 1000 --create-home user
USER 1000
WORKDIR /data
ENTRYPOINT ["univoxel"]
CMD ["--help"]
