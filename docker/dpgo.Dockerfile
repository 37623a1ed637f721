# The pose-graph solver. Built by `cargo xtask image`, whose build folder holds the static program and an empty data folder.
FROM scratch
COPY --chown=65532:65532 data /data
COPY coma-dpgo /coma-dpgo
USER 65532:65532
VOLUME /data
EXPOSE 7021/tcp
ENTRYPOINT ["/coma-dpgo", "--data", "/data"]
CMD ["--listen", "0.0.0.0:7021"]
