# docker build -t fg-calib . && docker run --rm -v "$PWD:/data" fg-calib calibrate calibration.yaml
FROM python:3.12-slim

WORKDIR /src
COPY . .
RUN pip install --no-cache-dir . && useradd --create-home --uid 1000 calibrator && mkdir /data && chown calibrator /data

USER 1000
ENV NUMBA_CACHE_DIR=/home/calibrator/.cache/numba
WORKDIR /home/calibrator
# Compiles the kernels, and shows that the image works.
RUN fg-calib example space-robot --out demo && fg-calib calibrate demo/calibration.yaml --out demo/result

WORKDIR /data
ENTRYPOINT ["fg-calib"]
CMD ["--help"]
