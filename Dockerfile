# Two stages: what only the build needs stays in the first, and only the finished program reaches the second.
# Both need Python 3.11 or newer with venv. Any Debian-like base will do: --build-arg BASE=...
ARG BASE=docker.io/library/python:3.12-slim-bookworm

FROM ${BASE} AS build
ENV PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY requirements/run.txt requirements/build.txt requirements/
RUN python3 -m venv /opt/lensmodel \
 && /opt/lensmodel/bin/pip install --require-hashes --requirement requirements/run.txt \
 && python3 -m venv /opt/build \
 && /opt/build/bin/pip install --require-hashes --requirement requirements/build.txt
COPY pyproject.toml README.md LICENSE ./
COPY lensmodel lensmodel
RUN /opt/build/bin/python -m hatchling build --target wheel --directory /wheels \
 && /opt/lensmodel/bin/pip install --no-deps --no-index /wheels/*.whl

FROM ${BASE}
RUN groupadd --gid 10001 lens \
 && useradd --uid 10001 --gid lens --no-create-home --home-dir /data --shell /usr/sbin/nologin lens \
 && groupadd --gid 10002 lens-task \
 && useradd --uid 10002 --gid lens-task --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin lens-task \
 && usermod --append --groups lens-task lens \
 && install --directory --owner=lens --group=lens --mode=0750 /data
COPY --from=build /opt/lensmodel /opt/lensmodel
# The service is an application: it runs from its tree and is never installed among other packages.
COPY app /srv/lensmodel/app
COPY migrations /srv/lensmodel/migrations
COPY --chmod=755 tools/container_entry.sh /usr/local/bin/lensmodel-entry
# Listening on every address of a container reaches nobody: publishing its port does, and that is
# the host's decision (compose.yaml publishes it on loopback). LENS_ALLOWED_HOSTS has it ask for keys; the first
# is made by the command "keys create" in a container with the same volume. Whoever publishes it under a
# name gives that name in LENS_ALLOWED_HOSTS; addresses and local names are answered to anyway.
ENV PATH=/opt/lensmodel/bin:$PATH \
    PYTHONPATH=/srv/lensmodel \
    HOME=/data \
    LENS_DATA_DIR=/data \
    LENS_HOST=0.0.0.0 \
    LENS_PORT=8000 \
    LENS_ALLOWED_HOSTS=localhost \
    LENS_LOG_FORMAT=json \
    NUMBA_CACHE_DIR=/data/cache \
    OMP_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    TMPDIR=/data/tmp
USER 10001:10001
# The root file system may be read-only: everything that is written lies under /data.
VOLUME /data
WORKDIR /data
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=30s --timeout=5s --start-period=60s --retries=3 \
  CMD ["python3", "-c", "import os, urllib.request as u; u.urlopen('http://127.0.0.1:' + os.environ['LENS_PORT'] + '/readyz', timeout=4)"]
ENTRYPOINT ["lensmodel-entry"]
CMD ["serve"]
