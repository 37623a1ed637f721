# Place recognition with the builtin descriptor (see place-recognition-onnx.Dockerfile for models). Built by `cargo xtask image`, whose build folder holds the static program and an empty data folder.
FROM scratch
COPY --chown=65532:65532 data /data
COPY coma-place-recognition /coma-place-recognition
USER 65532:65532
VOLUME /data
EXPOSE 7011/tcp
ENTRYPOINT ["/coma-place-recognition", "--data", "/data"]
CMD ["--listen", "0.0.0.0:7011"]
