# The gateway: HTTP for people and programs. Built by `cargo xtask image`, whose build folder holds the static program and an empty data folder.
FROM scratch
COPY --chown=65532:65532 data /data
COPY coma-viewer-gateway /coma-viewer-gateway
USER 65532:65532
VOLUME /data
EXPOSE 8080/tcp
ENTRYPOINT ["/coma-viewer-gateway", "--data", "/data"]
CMD ["--listen", "0.0.0.0:8080"]
