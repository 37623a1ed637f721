# The whole program. `agent` runs an agent with its place-recognition and dpgo in one process.
# Built by `cargo xtask image`, whose build folder holds the static program and an empty data folder.
FROM scratch
COPY --chown=65532:65532 data /data
COPY coma /coma
USER 65532:65532
VOLUME /data
EXPOSE 7001/tcp 7002/udp 8080/tcp
ENTRYPOINT ["/coma"]
CMD ["--help"]
