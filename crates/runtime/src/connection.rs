//! What a handler may know of the connection that a request came on.

use crate::ledger::Class;
use crate::socket::Accepted;
use std::net::SocketAddr;
use tonic::transport::CertificateDer;
use tonic::transport::server::TlsConnectInfo;

/// The connection of a request.
#[derive(Clone, Debug)]
pub struct Connection {
    accepted: Accepted,
    certificate: Option<CertificateDer<'static>>,
}

/// A peer's certificate names somebody else.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the certificate names {found:?}, not {claimed:?}")]
pub struct NameMismatch {
    /// Who the caller said to be.
    pub claimed: String,
    /// Whom its certificate names.
    pub found: Vec<String>,
}

impl Connection {
    /// The connection of a request that came through [`crate::Bound::serve`].
    pub fn of<T>(request: &tonic::Request<T>) -> Option<Connection> {
        Self::from_extensions(|| request.extensions().get(), request.extensions().get())
    }

    pub(crate) fn of_http<B>(request: &http::Request<B>) -> Option<Connection> {
        Self::from_extensions(|| request.extensions().get(), request.extensions().get())
    }

    fn from_extensions<'a>(
        tls: impl Fn() -> Option<&'a TlsConnectInfo<Accepted>>,
        accepted: Option<&Accepted>,
    ) -> Option<Connection> {
        let certificate = tls().and_then(|tls| tls.peer_certs()).and_then(|chain| chain.first().cloned());
        Some(Connection { accepted: accepted?.clone(), certificate })
    }

    /// Who calls.
    pub fn remote_addr(&self) -> SocketAddr {
        self.accepted.remote_addr
    }

    /// From now on, and for what went before, this connection's bytes count as of another class: a
    /// connection becomes [`Class::Peer`] when a Hello comes on it.
    pub fn set_class(&self, class: Class) {
        self.accepted.tally.set_class(class);
    }

    /// True if the caller proved itself by a certificate of the configured authority.
    pub fn has_certificate(&self) -> bool {
        self.certificate.is_some()
    }

    /// The DNS names of the caller's certificate; empty without one.
    pub fn certificate_names(&self) -> Vec<String> {
        let Some(der) = &self.certificate else { return Vec::new() };
        match webpki::EndEntityCert::try_from(der) {
            Ok(certificate) => certificate.valid_dns_names().map(str::to_owned).collect(),
            Err(_) => Vec::new(),
        }
    }

    /// Under mutual TLS, the certificate must name the agent that the caller says to be. Without a
    /// certificate there is nothing to compare.
    pub fn check_name(&self, agent_id: &str) -> Result<(), NameMismatch> {
        if !self.has_certificate() {
            return Ok(());
        }
        let found = self.certificate_names();
        if found.iter().any(|name| name == agent_id) {
            return Ok(());
        }
        Err(NameMismatch { claimed: agent_id.chars().take(80).collect(), found })
    }
}
