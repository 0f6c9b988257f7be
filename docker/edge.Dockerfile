# The edge: the decision service, its LLM and its token vocabulary. At run time it downloads nothing.
# `make release` builds it with its version; built without VERSION, it calls itself 0.1.0.dev0.
#   docker build --build-arg VERSION=1.2.3 -f docker/edge.Dockerfile -t aicvds-edge .
#   docker run --rm -p 127.0.0.1:8000:8000 -e AICVDS_ANONYMOUS=on aicvds-edge

FROM python:3.11-slim-bookworm AS dependencies
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore PATH=/opt/aicvds/bin:$PATH
WORKDIR /src
RUN python -m venv /opt/aicvds
COPY constraints.txt pyproject.toml ./
# Without the source, this installs an empty aic-vds with all its requirements, and the layer stays valid after every
# edit of the source.
RUN touch README.md LICENSE && pip install --constraint constraints.txt '.[service,mqtt,otel,postgres]'

# Only these files, so that an edit elsewhere does not download the model again.
FROM dependencies AS model
COPY shared/ shared/
COPY service/__init__.py service/
COPY service/commands/__init__.py service/commands/fetch_model.py service/commands/
COPY service/llm/__init__.py service/llm/model_file.py service/llm/
COPY service/prompting/__init__.py service/prompting/tokenizer.py service/prompting/
COPY service/config/__init__.py service/config/settings.py service/config/
RUN PYTHONPATH=/src AICVDS_CACHE_DIR=/opt/model aicvds model fetch

FROM dependencies AS application
COPY README.md LICENSE ./
COPY shared/ shared/
COPY service/ service/
# `aicvds mqtt`.
COPY field/ field/
# `make release` passes the version: there is no git here, and with git every commit would rebuild the layers above.
ARG VERSION=""
RUN SETUPTOOLS_SCM_PRETEND_VERSION_FOR_AIC_VDS=$VERSION pip wheel --no-deps --wheel-dir /wheels .

# This stage removes files that a running edge never opens, as docker/check_edge.py proves below:
# - symbol tables of shared libraries (some 150 MB, 80 llama.cpp's), which only debuggers need. The libraries in
#   *.libs stay: their wheels rearranged them, and strip breaks them;
# - the packages' own tests.
# Bytecode (__pycache__, 165 MB) stays: with a read-only root every start would compile it again.
FROM dependencies AS slim
RUN apt-get update -q && apt-get install -y -q --no-install-recommends binutils
RUN python -m pip uninstall --quiet --yes pip \
 && cd /opt/aicvds/lib/python3.11/site-packages \
 && find . -type f \( -name '*.so' -o -name '*.so.*' \) ! -path './*.libs/*' -exec strip --strip-unneeded {} + \
 && find . -type d -name tests -prune -exec rm -rf {} +

# The layers go from the largest and most stable to the smallest: an edit of the source ships kilobytes.
FROM python:3.11-slim-bookworm
# libgomp1: llama.cpp uses the system's OpenMP. tini: Python as process 1 would ignore a SIGTERM during its imports.
RUN apt-get update -q \
 && apt-get install -y -q --no-install-recommends libgomp1 tini \
 && apt-get clean && rm -rf /var/lib/apt/lists/* \
 && useradd --uid 10001 --user-group --no-create-home --shell /usr/sbin/nologin aicvds
COPY --from=slim /opt/aicvds /opt/aicvds
COPY --from=model /opt/model /opt/model
COPY --from=application /wheels /tmp/wheels
RUN python -m pip --python /opt/aicvds/bin/python install \
    --quiet --no-cache-dir --no-index --no-deps --force-reinstall /tmp/wheels/*.whl \
 && rm -r /tmp/wheels
# A named volume mounted here takes this owner. Without a volume and with a read-only root, missions are not stored.
RUN install --directory --owner=aicvds --group=aicvds /store
# Numba's functions are compiled here, for any processor: with a read-only root every start would compile them again.
ENV PATH=/opt/aicvds/bin:$PATH PYTHONUNBUFFERED=1 AICVDS_CACHE_DIR=/opt/model AICVDS_STORE=none NUMBA_CPU_NAME=generic
RUN python -c "from service.edge.compilation import compile_all; compile_all()"
COPY docker/check_edge.py /opt/aicvds/
# A checkout under umask 027 or 077 has it for its owner alone.
RUN chmod 644 /opt/aicvds/check_edge.py
USER 10001:10001
RUN python /opt/aicvds/check_edge.py
EXPOSE 8000
# Healthy: the edge decides, and its LLM is not loading any more (ready, off, or known to be unavailable).
HEALTHCHECK --interval=5s --timeout=3s --start-period=120s --retries=3 CMD ["python", "-c", \
  "import json, sys, urllib.request as u; sys.exit(json.load(u.build_opener(u.ProxyHandler({})).open('http://127.0.0.1:8000/readyz', timeout=2))['llm'] == 'loading')"]
ENTRYPOINT ["tini", "--"]
CMD ["aicvds", "serve", "--host", "0.0.0.0", "--port", "8000"]
