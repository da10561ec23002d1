# Two stages: wheels are built where compilers may be, and only they reach the image that runs.
ARG BASE=python:3.12-slim-bookworm

FROM ${BASE} AS build
WORKDIR /src
COPY requirements/lock.txt requirements/lock.txt
RUN python3 -m venv /opt/lensmodel \
 && /opt/lensmodel/bin/pip install --no-cache-dir --disable-pip-version-check --require-hashes --requirement requirements/lock.txt
COPY pyproject.toml README.md LICENSE ./
COPY lensmodel lensmodel
COPY app app
COPY migrations migrations
RUN /opt/lensmodel/bin/pip install --no-cache-dir --disable-pip-version-check --no-deps --no-build-isolation .

FROM ${BASE}
RUN groupadd --gid 10001 lens && useradd --uid 10001 --gid lens --no-create-home --home-dir /data lens \
 && mkdir /data && chown lens:lens /data
COPY --from=build /opt/lensmodel /opt/lensmodel
ENV PATH=/opt/lensmodel/bin:$PATH \
    LENS_DATA_DIR=/data \
    OMP_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1 \
    NUMBA_CACHE_DIR=/data/cache \
    PYTHONDONTWRITEBYTECODE=1 \
    TMPDIR=/data/tmp
USER lens
VOLUME /data
EXPOSE 8000
STOPSIGNAL SIGTERM
# The root file system may be read-only: everything that is written lies under /data.
HEALTHCHECK --interval=30s --timeout=5s --start-period=60s --retries=3 \
  CMD ["python3", "-c", "import urllib.request as u; u.urlopen('http://127.0.0.1:8000/readyz', timeout=4)"]
CMD ["sh", "-c", "mkdir -p /data/tmp && exec lensmodel serve --host 0.0.0.0 --port 8000"]
