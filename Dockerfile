# simtest in a container, installed by pip from the checkout with the pinned packages; LLVM comes by pip too.
#   docker build -t simtest .
#   docker run --rm -v "$PWD:/data" simtest validate overview
FROM python:3.13-slim-bookworm

# libatomic: Mitsuba links it. EGL: `simtest view --screenshot` draws with it where there is no display.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libatomic1 libegl1 libegl-mesa0 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 simtest

WORKDIR /src
COPY . .
RUN pip install --no-cache-dir -c constraints.txt . \
    && rm -rf /src/*

# Kernels and generated anatomies are kept in the user's home.
USER 1000
WORKDIR /data
ENTRYPOINT ["simtest"]
CMD ["doctor"]
