//! A channel to a server: lazily connected, with limits, a token, TLS, and its bytes counted.

use crate::Secret;
use crate::around::{Request, Response};
use crate::ledger::{ByteLedger, Class, Tally};
use crate::meter::Metered;
use crate::socket::CountedStream;
use crate::tls::{ClientTls, TlsError};
use http::{HeaderValue, Uri};
use hyper_util::rt::TokioIo;
use serde::Deserialize;
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::net::TcpStream;
use tonic::transport::{self, Endpoint};
use tonic::{Status, TimeoutExpired};
use tower::Service;

/// How this process calls others.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClientSettings {
    /// Sent as `authorization: Bearer <token>`.
    pub token: Option<Secret>,
    /// For `https://` endpoints.
    pub tls: Option<ClientTls>,
    /// Longest time to connect, seconds. Default: 5.
    pub connect_timeout_s: f64,
    /// Longest time until a call's answer begins, seconds, where the call sets none. Default: 120.
    pub call_timeout_s: f64,
    /// Largest message, both ways, bytes. Default: 16 MiB. Callers apply it to their generated clients.
    pub max_message_bytes: usize,
    /// A connection that is silent for so long is probed, seconds. Default: 20.
    pub keepalive_s: f64,
}

impl Default for ClientSettings {
    fn default() -> Self {
        ClientSettings {
            token: None,
            tls: None,
            connect_timeout_s: 5.0,
            call_timeout_s: 120.0,
            max_message_bytes: 16 << 20,
            keepalive_s: 20.0,
        }
    }
}

/// Why a channel cannot be made; a server that does not answer shows when it is called.
#[derive(Debug, thiserror::Error)]
pub enum ChannelError {
    /// No URL.
    #[error("endpoint {endpoint:?} is no http:// or https:// URL with a host")]
    Endpoint {
        /// What was given.
        endpoint: String,
    },
    /// TLS files.
    #[error("{0}")]
    Tls(#[from] TlsError),
    /// A certificate or key that is none.
    #[error("tls: {0}")]
    Certificate(transport::Error),
    /// `https://` without saying whom to trust.
    #[error("endpoint {endpoint:?} needs tls settings")]
    NoTls {
        /// What was given.
        endpoint: String,
    },
    /// A token that is no header value.
    #[error("token holds characters that a header cannot")]
    Token,
    /// A setting out of range.
    #[error("{field} = {value} must be over 0 and at most 1e6 seconds")]
    Setting {
        /// Which.
        field: &'static str,
        /// Its value.
        value: f64,
    },
}

/// A channel for generated clients. Clones share its connection.
#[derive(Clone, Debug)]
pub struct Channel {
    inner: transport::Channel,
    authorization: Option<HeaderValue>,
    tally: Tally,
}

/// Makes a channel to `endpoint` (`http://host:port`). It connects when first used and again after a
/// break; its bytes are booked as of `class`.
pub fn channel(
    endpoint: &str,
    settings: &ClientSettings,
    ledger: &ByteLedger,
    class: Class,
) -> Result<Channel, ChannelError> {
    let bad = || ChannelError::Endpoint { endpoint: endpoint.chars().take(200).collect() };
    let uri: Uri = endpoint.parse().map_err(|_| bad())?;
    let secure = match (uri.scheme_str(), uri.host()) {
        (Some("http"), Some(host)) if !host.is_empty() => false,
        (Some("https"), Some(host)) if !host.is_empty() => true,
        _ => return Err(bad()),
    };
    for (field, value) in [
        ("connect_timeout_s", settings.connect_timeout_s),
        ("call_timeout_s", settings.call_timeout_s),
        ("keepalive_s", settings.keepalive_s),
    ] {
        if !(value > 0.0 && value <= 1e6) {
            return Err(ChannelError::Setting { field, value });
        }
    }
    let mut builder = Endpoint::from(uri)
        .connect_timeout(Duration::from_secs_f64(settings.connect_timeout_s))
        .timeout(Duration::from_secs_f64(settings.call_timeout_s))
        .http2_keep_alive_interval(Duration::from_secs_f64(settings.keepalive_s))
        .keep_alive_timeout(Duration::from_secs_f64(settings.keepalive_s))
        .keep_alive_while_idle(true)
        .initial_stream_window_size(Some(1 << 20))
        .initial_connection_window_size(Some(4 << 20));
    if secure {
        let no_tls = || ChannelError::NoTls { endpoint: endpoint.to_owned() };
        let tls = settings.tls.as_ref().ok_or_else(no_tls)?.config()?;
        builder = builder.tls_config(tls).map_err(ChannelError::Certificate)?;
    }
    let authorization = match &settings.token {
        None => None,
        Some(token) => {
            let mut value = HeaderValue::from_str(&format!("Bearer {}", token.reveal()))
                .map_err(|_| ChannelError::Token)?;
            value.set_sensitive(true);
            Some(value)
        }
    };
    let tally = ledger.open(class);
    let connections = tally.clone();
    let connector = tower::service_fn(move |uri: Uri| {
        let tally = connections.clone();
        async move {
            let host = uri.host().unwrap_or_default().trim_matches(['[', ']']);
            let port = uri.port_u16().unwrap_or(if uri.scheme_str() == Some("https") { 443 } else { 80 });
            let stream = TcpStream::connect((host, port)).await?;
            stream.set_nodelay(true)?;
            Ok::<_, std::io::Error>(TokioIo::new(CountedStream::dialed(stream, tally)))
        }
    });
    Ok(Channel { inner: builder.connect_with_connector_lazy(connector), authorization, tally })
}

impl Service<Request> for Channel {
    type Response = Response;
    type Error = transport::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Response, transport::Error>> + Send>>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), transport::Error>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, mut request: Request) -> Self::Future {
        if let Some(value) = &self.authorization {
            request.headers_mut().insert(http::header::AUTHORIZATION, value.clone());
        }
        let path = request.uri().path().to_owned();
        let request = request.map(|body| Metered::body(body, self.tally.clone(), &path, "Request"));
        let answer = self.inner.call(request);
        Box::pin(async move {
            match answer.await {
                Err(error) if timed_out(&error) => {
                    Ok(Status::deadline_exceeded(format!("{path}: no answer in time")).into_http())
                }
                other => other,
            }
        })
    }
}

fn timed_out(error: &(dyn std::error::Error + 'static)) -> bool {
    std::iter::successors(Some(error), |e| e.source()).any(|e| e.is::<TimeoutExpired>())
}
