//! A service that waits, and calls of it without generated code.
#![allow(dead_code, reason = "each test file uses its part")]

use coma_runtime::{Bound, ByteLedger, Channel, ClientSettings, Handle, ServerSettings, Services};
use std::convert::Infallible;
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tonic::body::Body;
use tonic::{Code, Status};
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus};
use tower::{Service, ServiceExt};

/// Answers `/test.Waits/<milliseconds>` after that time.
#[derive(Clone)]
pub struct Waits;

impl tonic::server::NamedService for Waits {
    const NAME: &'static str = "test.Waits";
}

impl Service<http::Request<Body>> for Waits {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<http::Response<Body>, Infallible>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        Box::pin(async move {
            let milliseconds = request.uri().path().rsplit('/').next().unwrap().parse().unwrap();
            tokio::time::sleep(Duration::from_millis(milliseconds)).await;
            Ok(Status::ok("").into_http())
        })
    }
}

pub async fn serve(settings: &ServerSettings, ledger: &ByteLedger) -> (Handle, String) {
    let bound = Bound::bind(settings).await.unwrap();
    let url = bound.url();
    let services = Services::new().with(Waits);
    (bound.serve(services, tonic_health::pb::FILE_DESCRIPTOR_SET, ledger).await.unwrap(), url)
}

pub fn dial(url: &str, settings: &ClientSettings) -> Channel {
    coma_runtime::channel(url, settings, &ByteLedger::default(), coma_runtime::Class::Client).unwrap()
}

/// Calls [`Waits`] and reads the status.
pub async fn wait(channel: &Channel, milliseconds: u64, timeout: Option<&str>) -> Status {
    let mut request = http::Request::post(format!("/test.Waits/{milliseconds}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers");
    if let Some(timeout) = timeout {
        request = request.header("grpc-timeout", timeout);
    }
    match channel.clone().ready().await.unwrap().call(request.body(Body::empty()).unwrap()).await {
        Ok(response) => Status::from_header_map(response.headers()).unwrap_or(Status::unknown("no status")),
        Err(error) => Status::unavailable(format!("{error:?}")),
    }
}

pub async fn code(channel: &Channel) -> Code {
    wait(channel, 0, None).await.code()
}

pub async fn healthy(channel: Channel, service: &str) -> bool {
    let request = HealthCheckRequest { service: service.into() };
    let answer = HealthClient::new(channel).check(request).await.unwrap();
    answer.into_inner().status() == ServingStatus::Serving
}
