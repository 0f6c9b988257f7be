# The simulator: the UAVs and the world. It reaches an edge over HTTP and writes a run's folder.
# `make release` builds it with its version; built without VERSION, it calls itself 0.1.0.dev0.
#   docker build --build-arg VERSION=1.2.3 -f docker/simulator.Dockerfile -t aicvds-simulator .
#   docker run --rm --network host -v aicvds-runs:/runs aicvds-simulator \
#     aicvds simulate --edge http://127.0.0.1:8000 --out /runs/first

FROM python:3.11-slim-bookworm AS dependencies
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore PATH=/opt/aicvds/bin:$PATH
WORKDIR /src
RUN python -m venv /opt/aicvds
COPY constraints.txt pyproject.toml ./
# Without the source, this installs an empty aic-vds with all its requirements, and the layer stays valid after every
# edit of the source.
RUN touch README.md LICENSE && pip install --constraint constraints.txt '.[simulator]'

FROM dependencies AS application
COPY README.md LICENSE ./
COPY shared/ shared/
COPY simulator/ simulator/
# `make release` passes the version: there is no git here, and with git every commit would rebuild the layers above.
ARG VERSION=""
RUN SETUPTOOLS_SCM_PRETEND_VERSION_FOR_AIC_VDS=$VERSION pip wheel --no-deps --wheel-dir /wheels .

# This stage removes files that no mission needs: the symbol tables of shared libraries (31 MB; not in *.libs, whose
# wheels rearranged them, and strip breaks them) and the packages' own tests (22 MB).
FROM dependencies AS slim
RUN apt-get update -q && apt-get install -y -q --no-install-recommends binutils
RUN python -m pip uninstall --quiet --yes pip setuptools \
 && cd /opt/aicvds/lib/python3.11/site-packages \
 && find . -type f \( -name '*.so' -o -name '*.so.*' \) ! -path './*.libs/*' -exec strip --strip-unneeded {} + \
 && find . -type d -name tests -prune -exec rm -rf {} +

FROM python:3.11-slim-bookworm
# A named volume takes the owner of the folder that it is mounted on.
RUN useradd --uid 10001 --user-group --no-create-home --shell /usr/sbin/nologin aicvds \
 && install --directory --owner=aicvds --group=aicvds /runs
COPY --from=slim /opt/aicvds /opt/aicvds
COPY --from=application /wheels /tmp/wheels
RUN python -m pip --python /opt/aicvds/bin/python install \
    --quiet --no-cache-dir --no-index --no-deps --force-reinstall /tmp/wheels/*.whl \
 && rm -r /tmp/wheels
# Matplotlib writes its list of fonts into a folder.
ENV PATH=/opt/aicvds/bin:$PATH PYTHONUNBUFFERED=1 MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /runs
USER 10001:10001
# A mission on board, with its report, shows that the removed files are not needed.
RUN aicvds simulate --policy eof --out /tmp/check && test -s /tmp/check/report.html && rm -r /tmp/check
CMD ["aicvds", "simulate", "--help"]
