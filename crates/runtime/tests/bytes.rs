//! The ledger against a proxy that counts what passes.

mod common;

use coma_runtime::ledger::FRAMING;
use coma_runtime::{ByteLedger, Class, ClientSettings, ServerSettings, channel};
use common::{healthy, serve};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// Passes bytes on between callers and `to`, counting both ways.
async fn proxy(to: SocketAddr) -> (SocketAddr, Arc<[AtomicU64; 2]>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let here = listener.local_addr().unwrap();
    let counts: Arc<[AtomicU64; 2]> = Arc::default();
    let shared = counts.clone();
    tokio::spawn(async move {
        while let Ok((caller, _)) = listener.accept().await {
            let server = TcpStream::connect(to).await.unwrap();
            let (from_caller, to_caller) = caller.into_split();
            let (from_server, to_server) = server.into_split();
            for (way, mut from, mut to) in [(0, from_caller, to_server), (1, from_server, to_caller)] {
                let shared = shared.clone();
                tokio::spawn(async move {
                    let mut buffer = vec![0; 65536];
                    while let Ok(n @ 1..) = from.read(&mut buffer).await {
                        shared[way].fetch_add(n as u64, Ordering::SeqCst);
                        to.write_all(&buffer[..n]).await.unwrap();
                    }
                });
            }
        }
    });
    (here, counts)
}

#[tokio::test]
async fn the_ledger_counts_what_a_proxy_sees() {
    let (server_side, caller_side) = (ByteLedger::default(), ByteLedger::default());
    let settings = ServerSettings { class: Class::Local, ..Default::default() };
    let (server, _) = serve(&settings, &server_side).await;
    let (addr, seen) = proxy(server.local_addr).await;
    let caller =
        channel(&format!("http://{addr}"), &ClientSettings::default(), &caller_side, Class::Peer).unwrap();
    for _ in 0..25 {
        assert!(healthy(caller.clone(), "test.Waits").await);
    }
    drop(caller);
    server.shutdown().await;
    // The last frames are on their way: wait until both accounts stand still and agree.
    let agree = async {
        loop {
            let seen = [0, 1].map(|way: usize| seen[way].load(Ordering::SeqCst));
            if seen == [caller_side.total(Class::Peer), server_side.total(Class::Local)] && seen[0] > 0 {
                return seen;
            }
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
    };
    let seen = tokio::time::timeout(std::time::Duration::from_secs(5), agree).await.expect("accounts agree");

    let lines = caller_side.snapshot();
    // HealthCheckRequest{service: 10 bytes}: 5 bytes of gRPC frame, 2 of tag and length, 10 of text.
    let checks = lines.iter().find(|line| line.message_type == "CheckRequest").unwrap();
    assert_eq!((checks.class, checks.messages, checks.bytes), (Class::Peer, 25, 25 * 17));
    assert_eq!(lines.iter().map(|line| line.bytes).sum::<u64>(), seen[0]);
    assert!(lines.iter().any(|line| line.message_type == FRAMING && line.bytes > 0));
    let answers = server_side.snapshot();
    let answers = answers.iter().find(|line| line.message_type == "CheckResponse").unwrap();
    assert_eq!((answers.class, answers.messages, answers.bytes), (Class::Local, 25, 25 * 7));
}
