# Prometheus with the stack's scrapes, alerts and page.
#
#   docker build -f deploy/prometheus.Dockerfile -t cpn-prometheus .
ARG PROMETHEUS_IMAGE=prom/prometheus:v3.5.0
FROM ${PROMETHEUS_IMAGE}

USER root
RUN mkdir -p /data && chown 10001:10001 /data
USER 10001:10001
WORKDIR /data
COPY deploy/prometheus/ /etc/prometheus/
# Flags that Prometheus 2.42, Debian's, and 3.x have both.
CMD ["--config.file=/etc/prometheus/prometheus.yml", "--storage.tsdb.path=/data", "--storage.tsdb.retention.time=15d", \
     "--web.console.templates=/etc/prometheus/consoles"]
