# TensorBoard over the volume of runs; docker-compose.yml's profile `tensorboard` starts it.
ARG BASE=python:3.11-slim-bookworm
FROM ${BASE}
ARG PIP_INDEX_URL
ARG PIP_EXTRA_INDEX_URL
RUN python3 -m venv /opt/tensorboard \
 && /opt/tensorboard/bin/pip install --no-cache-dir --disable-pip-version-check tensorboard "setuptools<81"
USER 1000:1000
EXPOSE 6006
CMD ["/opt/tensorboard/bin/tensorboard", "--logdir", "/runs", "--bind_all", "--port", "6006"]
