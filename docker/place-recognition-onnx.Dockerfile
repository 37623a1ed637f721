# Place recognition with ONNX Runtime: a dynamic program and the libraries that it and the runtime are linked
# to, gathered by `cargo xtask image --onnxruntime FILE`. Mount the model and its manifest, and name the
# manifest in the configuration.
FROM scratch
COPY root /
COPY --chown=65532:65532 data /data
COPY coma-place-recognition /coma-place-recognition
ENV ORT_DYLIB_PATH=/usr/lib/libonnxruntime.so
USER 65532:65532
VOLUME /data
EXPOSE 7011/tcp
ENTRYPOINT ["/coma-place-recognition", "--data", "/data"]
CMD ["--listen", "0.0.0.0:7011"]
