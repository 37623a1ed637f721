//! The stack of every server, from a caller's side.

mod common;

use coma_runtime::{Bound, ByteLedger, ClientSettings, Secret, ServerSettings};
use common::{code, dial, healthy, serve, wait};
use std::time::{Duration, Instant};
use tokio_stream::StreamExt;
use tonic::Code;

fn with_token(token: &str) -> ClientSettings {
    ClientSettings { token: Some(Secret::new(token)), ..Default::default() }
}

#[tokio::test]
async fn loopback_is_open_until_a_token_is_set() {
    let (_server, url) = serve(&ServerSettings::default(), &ByteLedger::default()).await;
    assert_eq!(code(&dial(&url, &ClientSettings::default())).await, Code::Ok);

    let settings = ServerSettings { token: Some(Secret::new("right")), ..Default::default() };
    let (_server, url) = serve(&settings, &ByteLedger::default()).await;
    assert_eq!(code(&dial(&url, &with_token("right"))).await, Code::Ok);
    assert_eq!(code(&dial(&url, &with_token("wrong"))).await, Code::Unauthenticated);
    let none = dial(&url, &ClientSettings::default());
    let refused = wait(&none, 0, None).await;
    assert_eq!(refused.code(), Code::Unauthenticated);
    assert!(refused.message().starts_with("authorization: missing"), "{}", refused.message());
    assert!(healthy(none, "test.Waits").await, "health needs no token");
}

#[tokio::test]
async fn a_server_beyond_loopback_needs_a_token_or_a_word() {
    let everywhere = ServerSettings { listen: "0.0.0.0:0".parse().unwrap(), ..Default::default() };
    let error = Bound::bind(&everywhere).await.err().unwrap().to_string();
    assert!(error.contains("server.token") && error.contains("insecure"), "{error}");
    let token = ServerSettings { token: Some(Secret::new("t")), ..everywhere.clone() };
    assert!(Bound::bind(&token).await.is_ok());
    let insecure = ServerSettings { insecure: true, ..everywhere.clone() };
    assert!(Bound::bind(&insecure).await.is_ok());
    let empty = ServerSettings { token: Some(Secret::new("")), ..everywhere };
    assert!(Bound::bind(&empty).await.is_err(), "an empty token is none");
}

#[tokio::test]
async fn a_taken_port_is_named() {
    let first = Bound::bind(&ServerSettings::default()).await.unwrap();
    let again = ServerSettings { listen: first.local_addr, ..Default::default() };
    let error = Bound::bind(&again).await.err().unwrap().to_string();
    assert!(error.contains(&first.local_addr.to_string()), "{error}");
}

#[tokio::test]
async fn a_call_that_takes_too_long_is_answered_by_its_deadline() {
    let settings = ServerSettings { max_call_s: 0.1, ..Default::default() };
    let (_server, url) = serve(&settings, &ByteLedger::default()).await;
    let channel = dial(&url, &ClientSettings::default());
    let begin = Instant::now();
    assert_eq!(wait(&channel, 5_000, None).await.code(), Code::DeadlineExceeded);
    assert_eq!(wait(&channel, 5_000, Some("50m")).await.code(), Code::DeadlineExceeded);
    assert!(begin.elapsed() < Duration::from_secs(2));
    assert_eq!(wait(&channel, 1, None).await.code(), Code::Ok);
    // A server that keeps no deadline: the caller's own clock ends the call.
    let (_server, url) = serve(&ServerSettings::default(), &ByteLedger::default()).await;
    let hasty = ClientSettings { call_timeout_s: 0.1, ..Default::default() };
    assert_eq!(wait(&dial(&url, &hasty), 5_000, None).await.code(), Code::DeadlineExceeded);
}

#[tokio::test]
async fn calls_beyond_the_limit_are_shed_and_health_still_answers() {
    let settings = ServerSettings { max_concurrent_calls: 2, ..Default::default() };
    let (_server, url) = serve(&settings, &ByteLedger::default()).await;
    let channel = dial(&url, &ClientSettings::default());
    // Each may itself be shed while the probes below are under work: it tries again.
    let busy: Vec<_> = (0..2)
        .map(|_| {
            let channel = channel.clone();
            tokio::spawn(async move { while wait(&channel, 300, None).await.code() != Code::Ok {} })
        })
        .collect();
    let probe = async {
        loop {
            let status = wait(&channel, 0, None).await;
            if status.code() != Code::Ok {
                return status;
            }
        }
    };
    let refused = tokio::time::timeout(Duration::from_secs(20), probe).await.expect("a call is shed");
    assert_eq!(refused.code(), Code::ResourceExhausted);
    assert!(refused.message().contains("2 calls"), "{}", refused.message());
    assert!(healthy(channel.clone(), "").await);
    for call in busy {
        call.await.unwrap();
    }
    assert_eq!(code(&channel).await, Code::Ok);
}

#[tokio::test]
async fn health_and_reflection_answer() {
    let (server, url) = serve(&ServerSettings::default(), &ByteLedger::default()).await;
    let channel = dial(&url, &ClientSettings::default());
    assert!(healthy(channel.clone(), "").await);
    assert!(healthy(channel.clone(), "test.Waits").await);
    server.set_healthy("test.Waits", false).await;
    assert!(!healthy(channel.clone(), "test.Waits").await);

    use tonic_reflection::pb::v1::{
        ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
        server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
    };
    let ask = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let answers = ServerReflectionClient::new(channel).server_reflection_info(tokio_stream::once(ask)).await;
    let answer = answers.unwrap().into_inner().next().await.unwrap().unwrap();
    let Some(MessageResponse::ListServicesResponse(list)) = answer.message_response else { panic!() };
    assert!(list.service.iter().any(|s| s.name == "grpc.health.v1.Health"));
}

#[tokio::test]
async fn calls_under_work_end_in_the_grace_time_and_the_port_is_free_again() {
    let settings = ServerSettings { shutdown_grace_s: 0.6, ..Default::default() };
    let (server, url) = serve(&settings, &ByteLedger::default()).await;
    let channel = dial(&url, &ClientSettings::default());
    assert_eq!(code(&channel).await, Code::Ok);
    let [short, long] = [100, 60_000].map(|milliseconds| {
        let channel = channel.clone();
        tokio::spawn(async move { wait(&channel, milliseconds, None).await.code() })
    });
    tokio::time::sleep(Duration::from_millis(50)).await;
    let listen = server.local_addr;
    let begin = Instant::now();
    server.shutdown().await;
    assert!(begin.elapsed() < Duration::from_secs(3), "{:?}", begin.elapsed());
    assert_eq!(short.await.unwrap(), Code::Ok);
    assert_ne!(long.await.unwrap(), Code::Ok);
    assert!(Bound::bind(&ServerSettings { listen, ..Default::default() }).await.is_ok());
}

#[tokio::test]
async fn a_channel_comes_back_when_its_server_does() {
    let (server, url) = serve(&ServerSettings::default(), &ByteLedger::default()).await;
    let channel = dial(&url, &ClientSettings::default());
    assert_eq!(code(&channel).await, Code::Ok);
    let listen = server.local_addr;
    server.shutdown().await;
    assert_eq!(code(&channel).await, Code::Unavailable);
    let (_server, _) = serve(&ServerSettings { listen, ..Default::default() }, &ByteLedger::default()).await;
    assert_eq!(code(&channel).await, Code::Ok);
}

#[test]
fn an_endpoint_that_is_no_url_is_refused_by_name() {
    for bad in ["", "agent:7000", "ftp://x", "http://", "/path"] {
        let made = coma_runtime::channel(
            bad,
            &ClientSettings::default(),
            &ByteLedger::default(),
            coma_runtime::Class::Peer,
        );
        assert!(made.unwrap_err().to_string().contains(&format!("{bad:?}")), "{bad:?}");
    }
}

/// The answer to a plain HTTP/1.1 request.
async fn get(url: &str, path: &str, token: Option<&str>) -> String {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let host = url.strip_prefix("http://").unwrap();
    let mut stream = tokio::net::TcpStream::connect(host).await.unwrap();
    let token = token.map(|token| format!("authorization: Bearer {token}\r\n")).unwrap_or_default();
    let request = format!("GET {path} HTTP/1.1\r\nhost: {host}\r\nconnection: close\r\n{token}\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    answer
}

#[tokio::test]
async fn metrics_are_told_over_plain_http_behind_the_same_token() {
    coma_runtime::metrics::install();
    metrics::counter!("coma_server_test_total").increment(5);
    let (_server, url) = serve(&ServerSettings::default(), &ByteLedger::default()).await;
    let answer = get(&url, "/metrics", None).await;
    assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("coma_server_test_total 5"), "{answer}");

    let settings = ServerSettings { token: Some(Secret::new("right")), ..Default::default() };
    let (_server, url) = serve(&settings, &ByteLedger::default()).await;
    for token in [None, Some("wrong")] {
        let answer = get(&url, "/metrics", token).await;
        assert!(answer.starts_with("HTTP/1.1 401") && !answer.contains("coma_server_test_total"), "{answer}");
    }
    assert!(get(&url, "/metrics", Some("right")).await.contains("coma_server_test_total 5"));
}
