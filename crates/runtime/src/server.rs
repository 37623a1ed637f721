//! A gRPC server: bound, served behind one stack of layers, ended in order.

use crate::around::{Next, Request, Response, around, pass};
use crate::auth::Policy;
use crate::connection::Connection;
use crate::ledger::{ByteLedger, Class};
use crate::meter::Metered;
use crate::socket::{Accepted, CountedStream};
use crate::tls::{ServerTls, TlsError};
use crate::{Secret, deadline};
use serde::Deserialize;
use std::convert::Infallible;
use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::server::NamedService;
use tonic::service::RoutesBuilder;
use tonic::{Status, transport};
use tonic_health::server::HealthReporter;
use tower::{Layer, Service, ServiceBuilder};

/// How a server listens and what it bears.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServerSettings {
    /// Address and port; port 0 takes a free one. Default: a free port on loopback.
    pub listen: SocketAddr,
    /// Callers must send `authorization: Bearer <token>`. Without one, only loopback is open.
    pub token: Option<Secret>,
    /// Listen beyond loopback without a token or certificates. Default: no.
    pub insecure: bool,
    /// TLS, and mutual TLS where it names an authority for callers.
    pub tls: Option<ServerTls>,
    /// Largest message, both ways, bytes. Default: 16 MiB, a raw 1920x1080 RGB-D frame with room to spare.
    /// Services apply it to their generated servers.
    pub max_message_bytes: usize,
    /// Calls that may be under work at once; more are refused with RESOURCE_EXHAUSTED. Default: 256.
    pub max_concurrent_calls: usize,
    /// Connections at once; more wait to be accepted. Default: 1024.
    pub max_connections: usize,
    /// Longest time until a call's answer begins, seconds. Default: 120. Streams may then last.
    pub max_call_s: f64,
    /// How long calls may go on after the server was asked to end, seconds. Default: 5.
    pub shutdown_grace_s: f64,
    /// How the bytes that this server writes are booked until something else is known of a connection.
    pub class: Class,
}

impl Default for ServerSettings {
    fn default() -> Self {
        ServerSettings {
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            token: None,
            insecure: false,
            tls: None,
            max_message_bytes: 16 << 20,
            max_concurrent_calls: 256,
            max_connections: 1024,
            max_call_s: 120.0,
            shutdown_grace_s: 5.0,
            class: Class::Client,
        }
    }
}

/// Why a server did not start.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The address is reachable from elsewhere, and nothing says who may call.
    #[error(
        "server.listen = {listen} is reachable from other machines, but neither server.token nor \
         server.tls.client_ca is set; set one of them, or server.insecure = true if the network is trusted"
    )]
    Open {
        /// The address.
        listen: SocketAddr,
    },
    /// The port cannot be had.
    #[error("cannot listen on {listen}: {source}")]
    Bind {
        /// The address.
        listen: SocketAddr,
        /// Why.
        source: std::io::Error,
    },
    /// TLS files.
    #[error("server.{0}")]
    Tls(#[from] TlsError),
    /// A certificate or key that is none.
    #[error("server.tls: {0}")]
    Certificate(transport::Error),
    /// A setting out of range.
    #[error("server.{field} = {value} must be {needed}")]
    Setting {
        /// Which.
        field: &'static str,
        /// Its value.
        value: f64,
        /// What is taken.
        needed: &'static str,
    },
}

/// Services to be served together.
#[derive(Default)]
pub struct Services {
    routes: RoutesBuilder,
    names: Vec<&'static str>,
}

impl Services {
    /// None yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a generated server; health and reflection will know it.
    pub fn with<S>(mut self, service: S) -> Self
    where
        S: Service<Request, Response = Response, Error = Infallible>
            + NamedService
            + Clone
            + Send
            + Sync
            + 'static,
        S::Future: Send + 'static,
    {
        self.routes.add_service(service);
        self.names.push(S::NAME);
        self
    }
}

/// A server that has its port and does not answer yet: its services can be told where they live.
pub struct Bound {
    /// The address, with the port that was had.
    pub local_addr: SocketAddr,
    listener: TcpListener,
    settings: ServerSettings,
    policy: Policy,
    tls: Option<transport::ServerTlsConfig>,
    stop: CancellationToken,
}

impl Bound {
    /// Checks the settings and takes the port.
    pub async fn bind(settings: &ServerSettings) -> Result<Bound, ServeError> {
        let listen = settings.listen;
        let mutual = settings.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some());
        let policy = match &settings.token {
            Some(token) if token.reveal().is_empty() => {
                return Err(ServeError::Setting { field: "token", value: 0.0, needed: "not empty" });
            }
            Some(token) => Policy::Token(token.clone()),
            None if mutual => Policy::Certificate,
            None if listen.ip().is_loopback() || settings.insecure => Policy::Open,
            None => return Err(ServeError::Open { listen }),
        };
        for (field, value) in [
            ("max_call_s", settings.max_call_s),
            ("shutdown_grace_s", settings.shutdown_grace_s),
            ("max_concurrent_calls", settings.max_concurrent_calls as f64),
            ("max_connections", settings.max_connections as f64),
        ] {
            if !(value > 0.0 && value <= 1e6) {
                return Err(ServeError::Setting { field, value, needed: "over 0 and at most 1e6" });
            }
        }
        let tls = settings.tls.as_ref().map(ServerTls::config).transpose()?;
        // Before there is anything to count.
        crate::metrics::install();
        let bind = |source| ServeError::Bind { listen, source };
        let listener = TcpListener::bind(listen).await.map_err(bind)?;
        let local_addr = listener.local_addr().map_err(bind)?;
        if settings.insecure && !local_addr.ip().is_loopback() && matches!(policy, Policy::Open) {
            tracing::warn!(%local_addr, "open to everyone who can reach it (insecure = true)");
        }
        Ok(Bound {
            local_addr,
            listener,
            settings: settings.clone(),
            policy,
            tls,
            stop: CancellationToken::new(),
        })
    }

    /// `http://` or `https://` and the address, for callers on this machine.
    pub fn url(&self) -> String {
        let scheme = if self.tls.is_some() { "https" } else { "http" };
        format!("{scheme}://{}", self.local_addr)
    }

    /// Cancelled when the server is asked to end: streams that would go on forever watch it.
    pub fn stopping(&self) -> CancellationToken {
        self.stop.clone()
    }

    /// Serves, with health, reflection (`descriptor_set` is the encoded contract) and the process's metrics under
    /// `GET /metrics`, until the handle is shut down or dropped. From outside in: byte counts, authorization, admission
    /// with load shedding, deadline.
    pub async fn serve(
        self,
        services: Services,
        descriptor_set: &'static [u8],
        ledger: &ByteLedger,
    ) -> Result<Handle, ServeError> {
        let Bound { local_addr, listener, settings, policy, tls, stop } = self;
        let (health, health_service) = tonic_health::server::health_reporter();
        for name in services.names.iter().copied().chain([""]) {
            health.set_service_status(name, tonic_health::ServingStatus::Serving).await;
        }
        let reflection = tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(descriptor_set)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
            .build_v1()
            .expect("the descriptor sets are written by our own build");
        let mut routes = services.routes;
        routes.add_service(health_service);
        routes.add_service(reflection);

        let mut server = transport::Server::builder()
            // For GET /metrics.
            .accept_http1(true)
            .http2_keepalive_interval(Some(Duration::from_secs(20)))
            .http2_keepalive_timeout(Some(Duration::from_secs(20)))
            .http2_max_header_list_size(Some(16 << 10))
            .max_concurrent_streams(Some(256))
            .initial_stream_window_size(Some(1 << 20))
            .initial_connection_window_size(Some(4 << 20))
            .layer(stack(&settings, policy));
        if let Some(tls) = tls {
            server = server.tls_config(tls).map_err(ServeError::Certificate)?;
        }

        let close = CancellationToken::new();
        let incoming = incoming(listener, &settings, ledger.clone(), close.clone());
        let asked = stop.clone().cancelled_owned();
        let serving = server.serve_with_incoming_shutdown(routes.routes(), incoming, asked);
        let grace = Duration::from_secs_f64(settings.shutdown_grace_s);
        let (asked, reporter) = (stop.clone(), health.clone());
        let task = tokio::spawn(async move {
            let serving = std::pin::pin!(serving);
            let ended = tokio::select! {
                ended = serving => Some(ended),
                () = async {
                    asked.cancelled().await;
                    for name in services.names.iter().copied().chain([""]) {
                        reporter.set_service_status(name, tonic_health::ServingStatus::NotServing).await;
                    }
                    tokio::time::sleep(grace).await;
                } => None,
            };
            // What is still open now is closed.
            close.cancel();
            if let Some(Err(error)) = ended {
                tracing::error!(%local_addr, error = &error as &dyn std::error::Error, "server ended");
            }
        });
        tracing::info!(%local_addr, "serving");
        Ok(Handle { local_addr, stop, health, task })
    }
}

/// The stack of every server, from outside in.
fn stack<S>(
    settings: &ServerSettings,
    policy: Policy,
) -> impl Layer<S, Service = StackService> + Clone + use<S>
where
    S: Service<Request, Response = Response, Error = Infallible> + Clone + Send + Sync + 'static,
    S::Future: Send + 'static,
{
    let policy = Arc::new(policy);
    let places = Arc::new(Semaphore::new(settings.max_concurrent_calls));
    let limit = settings.max_concurrent_calls;
    let longest = Duration::from_secs_f64(settings.max_call_s);
    let stack = ServiceBuilder::new()
        .layer(around(metered as fn(_, _) -> _))
        .layer(around(move |request, next| authorized(policy.clone(), request, next)))
        .layer(around(measured as fn(_, _) -> _))
        .layer(around(move |request, next| admitted(places.clone(), limit, request, next)))
        .layer(around(move |request, next| in_time(longest, request, next)));
    tower::layer::layer_fn(move |inner: S| StackService::new(stack.service(inner)))
}

type StackService = tower::util::BoxCloneSyncService<Request, Response, Infallible>;

async fn metered(request: Request, next: Next) -> Response {
    let tally = request.extensions().get::<Accepted>().map(|accepted| accepted.tally.clone());
    let path = request.uri().path().to_owned();
    let response = pass(next, request).await;
    match tally {
        Some(tally) => response.map(|body| Metered::body(body, tally, &path, "Response")),
        None => response,
    }
}

async fn authorized(policy: Arc<Policy>, request: Request, next: Next) -> Response {
    match policy.check(&request) {
        Ok(()) => pass(next, request).await,
        Err(status) => {
            let from = Connection::of_http(&request).map(|c| c.remote_addr());
            tracing::warn!(path = request.uri().path(), ?from, reason = status.message(), "refused a call");
            match request.uri().path() {
                METRICS => text(http::StatusCode::UNAUTHORIZED, status.message().to_owned()),
                _ => status.into_http(),
            }
        }
    }
}

/// Where a server answers plain HTTP, with its process's metrics in Prometheus' text format.
const METRICS: &str = "/metrics";

async fn measured(request: Request, next: Next) -> Response {
    match request.uri().path() {
        METRICS => text(http::StatusCode::OK, crate::metrics::render()),
        _ => pass(next, request).await,
    }
}

fn text(status: http::StatusCode, text: String) -> Response {
    let mut response = http::Response::new(tonic::body::Body::new(text));
    *response.status_mut() = status;
    let plain = http::HeaderValue::from_static("text/plain; version=0.0.4; charset=utf-8");
    response.headers_mut().insert(http::header::CONTENT_TYPE, plain);
    response
}

async fn admitted(places: Arc<Semaphore>, limit: usize, request: Request, next: Next) -> Response {
    // An orchestrator must not take a busy server for a dead one.
    if request.uri().path().starts_with("/grpc.health.v1.Health/") {
        return pass(next, request).await;
    }
    match places.try_acquire() {
        Ok(_place) => pass(next, request).await,
        Err(_) => {
            let message = format!("{limit} calls are under work, the limit of this server; try again later");
            Status::resource_exhausted(message).into_http()
        }
    }
}

async fn in_time(longest: Duration, request: Request, next: Next) -> Response {
    let left = deadline::time_left(request.headers(), longest);
    match tokio::time::timeout(left, pass(next, request)).await {
        Ok(response) => response,
        Err(_) => Status::deadline_exceeded(format!("no answer within {left:?}")).into_http(),
    }
}

fn incoming(
    listener: TcpListener,
    settings: &ServerSettings,
    ledger: ByteLedger,
    close: CancellationToken,
) -> impl tokio_stream::Stream<Item = Result<CountedStream, std::io::Error>> + Send + Unpin + 'static {
    let class = settings.class;
    let places = Arc::new(Semaphore::new(settings.max_connections));
    let (accepted, connections) = tokio::sync::mpsc::channel(16);
    tokio::spawn(async move {
        loop {
            let Ok(place) = places.clone().acquire_owned().await else { return };
            let connection = tokio::select! {
                connection = listener.accept() => connection,
                // The server has ended.
                () = accepted.closed() => return,
            };
            match connection {
                Ok((stream, from)) => {
                    // Small messages go at once. A socket that refuses is only slower.
                    let _ = stream.set_nodelay(true);
                    let close = close.clone().cancelled_owned();
                    let stream = CountedStream::accepted(stream, ledger.open(class), place, close, from);
                    if accepted.send(Ok(stream)).await.is_err() {
                        return;
                    }
                }
                Err(error) => {
                    // Out of file descriptors, most likely: wait for some to be closed.
                    tracing::warn!(%error, "cannot accept a connection");
                    tokio::time::sleep(Duration::from_millis(50)).await;
                }
            }
        }
    });
    tokio_stream::wrappers::ReceiverStream::new(connections)
}

/// A running server. Dropping it asks it to end.
pub struct Handle {
    /// Where it listens.
    pub local_addr: SocketAddr,
    stop: CancellationToken,
    health: HealthReporter,
    task: JoinHandle<()>,
}

impl Handle {
    /// Asks it to end, waits for calls under work up to the grace time, closes what is left.
    pub async fn shutdown(mut self) {
        self.stop.cancel();
        self.done().await;
    }

    /// Resolves when it has ended.
    pub async fn done(&mut self) {
        if !self.task.is_finished()
            && let Err(error) = (&mut self.task).await
            && error.is_panic()
        {
            tracing::error!(%error, "the server's task panicked");
        }
    }

    /// Cancelled when it is asked to end.
    pub fn stopping(&self) -> CancellationToken {
        self.stop.clone()
    }

    /// Sets what the health service says of one service (`coma.v1.Dpgo`).
    pub async fn set_healthy(&self, service: &'static str, healthy: bool) {
        use tonic_health::ServingStatus::{NotServing, Serving};
        self.health.set_service_status(service, if healthy { Serving } else { NotServing }).await;
    }

    /// Serves until `end` resolves, then shuts down: the body of a program.
    pub async fn serve_until(mut self, end: impl Future<Output = ()>) {
        tokio::select! {
            () = end => self.shutdown().await,
            () = self.done() => {}
        }
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}
