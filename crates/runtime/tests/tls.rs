//! TLS and mutual TLS, with certificates made for the test.

mod common;

use coma_runtime::{Bound, ByteLedger, ClientSettings, ClientTls, Secret, ServerSettings, ServerTls};
use common::{code, dial, serve};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use std::path::PathBuf;
use tonic::Code;

/// An authority and what it signed, in a folder.
struct Authority {
    folder: tempfile::TempDir,
    issuer: CertifiedIssuer<'static, KeyPair>,
}

impl Authority {
    fn new() -> Self {
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let issuer = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("ca.pem"), issuer.pem()).unwrap();
        Authority { folder, issuer }
    }

    fn ca(&self) -> PathBuf {
        self.folder.path().join("ca.pem")
    }

    /// A certificate and its key.
    fn sign(&self, name: &str) -> (PathBuf, PathBuf) {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec![name.to_owned(), "localhost".to_owned()]).unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap();
        let path = |end: &str| self.folder.path().join(format!("{name}.{end}"));
        std::fs::write(path("pem"), certificate.pem()).unwrap();
        std::fs::write(path("key"), key.serialize_pem()).unwrap();
        (path("pem"), path("key"))
    }

    fn server(&self, mutual: bool, optional: bool) -> ServerSettings {
        let (certificate, key) = self.sign("agent-00");
        let client_ca = mutual.then(|| self.ca());
        let tls = ServerTls { certificate, key, client_ca, client_certificate_optional: optional };
        ServerSettings { tls: Some(tls), ..Default::default() }
    }

    fn client(&self, name: Option<&str>) -> ClientSettings {
        let (certificate, key) = name.map(|name| self.sign(name)).unzip();
        let server_name = Some("agent-00".to_owned());
        ClientSettings {
            tls: Some(ClientTls { ca: self.ca(), certificate, key, server_name }),
            ..Default::default()
        }
    }
}

#[tokio::test]
async fn tls_needs_the_right_authority() {
    let authority = Authority::new();
    let (_server, url) = serve(&authority.server(false, false), &ByteLedger::default()).await;
    assert!(url.starts_with("https://"));
    assert_eq!(code(&dial(&url, &authority.client(None))).await, Code::Ok);
    let stranger = Authority::new();
    assert_eq!(code(&dial(&url, &stranger.client(None))).await, Code::Unavailable);
    let plain = url.replace("https", "http");
    assert_eq!(code(&dial(&plain, &ClientSettings::default())).await, Code::Unavailable);
}

#[tokio::test]
async fn mutual_tls_needs_a_certificate_of_the_authority() {
    let authority = Authority::new();
    let (_server, url) = serve(&authority.server(true, false), &ByteLedger::default()).await;
    assert_eq!(code(&dial(&url, &authority.client(Some("agent-01")))).await, Code::Ok);
    assert_eq!(code(&dial(&url, &authority.client(None))).await, Code::Unavailable);
    let stranger = Authority::new();
    let mut forged = stranger.client(Some("agent-01"));
    forged.tls.as_mut().unwrap().ca = authority.ca();
    assert_eq!(code(&dial(&url, &forged)).await, Code::Unavailable);
}

#[tokio::test]
async fn peers_with_certificates_and_clients_with_tokens_share_a_port() {
    let authority = Authority::new();
    let mut settings = authority.server(true, true);
    settings.token = Some(Secret::new("t"));
    let (_server, url) = serve(&settings, &ByteLedger::default()).await;
    assert_eq!(code(&dial(&url, &authority.client(Some("agent-01")))).await, Code::Ok);
    assert_eq!(code(&dial(&url, &authority.client(None))).await, Code::Unauthenticated);
    let mut with_token = authority.client(None);
    with_token.token = Some(Secret::new("t"));
    assert_eq!(code(&dial(&url, &with_token)).await, Code::Ok);
}

#[tokio::test]
async fn missing_files_are_named() {
    let authority = Authority::new();
    let mut settings = authority.server(false, false);
    settings.tls.as_mut().unwrap().key = "/no/such.key".into();
    let error = Bound::bind(&settings).await.err().unwrap().to_string();
    assert!(error.starts_with("server.tls.key /no/such.key"), "{error}");
    let mut client = authority.client(Some("agent-01"));
    client.tls.as_mut().unwrap().key = None;
    let ledger = ByteLedger::default();
    let made = coma_runtime::channel("https://localhost:1", &client, &ledger, coma_runtime::Class::Peer);
    assert!(made.unwrap_err().to_string().contains("tls.key go together"));
}
