# skidloc as a command: docker run --rm -v "$PWD:/data" skidloc replay drive.mcap --robot husky_a200 --out results
FROM python:3.12-slim-bookworm AS build
WORKDIR /src
COPY pyproject.toml setup.py package.xml README.md LICENSE constraints.txt ./
COPY motion_models ./motion_models
COPY localization ./localization
COPY skidloc ./skidloc
RUN python -m venv /opt/skidloc \
    && /opt/skidloc/bin/pip install --no-cache-dir --constraint constraints.txt '.[ros2,parquet,fleet]'

FROM python:3.12-slim-bookworm
RUN useradd --create-home --uid 1000 skidloc
COPY --from=build /opt/skidloc /opt/skidloc
ENV PATH="/opt/skidloc/bin:$PATH" \
    NUMBA_CACHE_DIR=/home/skidloc/.cache/numba \
    MPLCONFIGDIR=/home/skidloc/.cache/matplotlib
USER 1000
WORKDIR /tmp
# compiles what a replay needs, once and not with each container
RUN skidloc warm-up
WORKDIR /data
ENTRYPOINT ["skidloc"]
CMD ["--help"]
