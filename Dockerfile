# Palpate with pinned versions of everything that it needs:
#   docker build --tag palpate .
#   docker run --rm --volume "$PWD":/data palpate estimate before.nii.gz after.nii.gz --output out
# `make lock` renews requirements.lock.
FROM python:3.12-slim-bookworm
ENV PYTHONDONTWRITEBYTECODE=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
WORKDIR /palpate
COPY requirements.lock .
RUN pip install --requirement requirements.lock
COPY . .
RUN pip install --no-deps --no-build-isolation . && rm -rf /palpate/*
RUN useradd --create-home palpate && mkdir /data && chown palpate /data
USER palpate
WORKDIR /data
RUN palpate --version
ENTRYPOINT ["palpate"]
CMD ["--help"]
