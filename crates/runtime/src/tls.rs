//! TLS and mutual TLS, from PEM files.

use serde::Deserialize;
use std::path::{Path, PathBuf};
use tonic::transport::{Certificate, ClientTlsConfig, Identity, ServerTlsConfig};

/// A server's side.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServerTls {
    /// Its certificate chain, PEM.
    pub certificate: PathBuf,
    /// Its private key, PEM.
    pub key: PathBuf,
    /// Callers' certificates must come from this authority (mutual TLS), PEM.
    pub client_ca: Option<PathBuf>,
    /// Callers may come without a certificate; they must show a token then. Peers and clients can so
    /// share a port.
    #[serde(default)]
    pub client_certificate_optional: bool,
}

/// A caller's side.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClientTls {
    /// Servers' certificates must come from this authority, PEM.
    pub ca: PathBuf,
    /// One's own certificate chain, for mutual TLS, PEM.
    pub certificate: Option<PathBuf>,
    /// Its private key, PEM.
    pub key: Option<PathBuf>,
    /// The name that the server's certificate must have, if it is not the endpoint's host.
    pub server_name: Option<String>,
}

/// Why TLS could not be set up.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read.
    #[error("{what} {path}: {source}", path = path.display())]
    Read {
        /// Which setting.
        what: &'static str,
        /// Its file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A certificate without its key, or the other way round.
    #[error("tls.certificate and tls.key go together; only {found} is set")]
    HalfIdentity {
        /// Which is set.
        found: &'static str,
    },
}

fn read(what: &'static str, path: &Path) -> Result<Vec<u8>, TlsError> {
    std::fs::read(path).map_err(|source| TlsError::Read { what, path: path.to_owned(), source })
}

impl ServerTls {
    /// Reads the files.
    pub fn config(&self) -> Result<ServerTlsConfig, TlsError> {
        let certificate = read("tls.certificate", &self.certificate)?;
        let identity = Identity::from_pem(certificate, read("tls.key", &self.key)?);
        let mut config =
            ServerTlsConfig::new().identity(identity).timeout(std::time::Duration::from_secs(10));
        if let Some(ca) = &self.client_ca {
            config = config
                .client_ca_root(Certificate::from_pem(read("tls.client_ca", ca)?))
                .client_auth_optional(self.client_certificate_optional);
        }
        Ok(config)
    }
}

impl ClientTls {
    /// Reads the files.
    pub fn config(&self) -> Result<ClientTlsConfig, TlsError> {
        let mut config =
            ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read("tls.ca", &self.ca)?));
        match (&self.certificate, &self.key) {
            (Some(certificate), Some(key)) => {
                let certificate = read("tls.certificate", certificate)?;
                config = config.identity(Identity::from_pem(certificate, read("tls.key", key)?));
            }
            (None, None) => {}
            (Some(_), None) => return Err(TlsError::HalfIdentity { found: "tls.certificate" }),
            (None, Some(_)) => return Err(TlsError::HalfIdentity { found: "tls.key" }),
        }
        if let Some(name) = &self.server_name {
            config = config.domain_name(name);
        }
        Ok(config)
    }
}
