# The agent alone; its place-recognition and dpgo run elsewhere. Built by `cargo xtask image`, whose build folder holds the static program and an empty data folder.
FROM scratch
COPY --chown=65532:65532 data /data
COPY coma-agent /coma-agent
USER 65532:65532
VOLUME /data
EXPOSE 7001/tcp 7002/udp
ENTRYPOINT ["/coma-agent", "--data", "/data"]
CMD ["--listen", "0.0.0.0:7001"]
