//! Who may call: the `authorization` metadata entry, read in one place.

use crate::Secret;
use crate::connection::Connection;
use http::header::AUTHORIZATION;
use tonic::Status;

/// Health checks are open: orchestrators cannot send tokens, and the answer says nothing else.
const OPEN: &str = "/grpc.health.v1.Health/";

/// What callers must show.
#[derive(Clone, Debug)]
pub(crate) enum Policy {
    /// Nothing: loopback, or so set.
    Open,
    /// `authorization: Bearer <token>`, or a certificate of the configured authority.
    Token(Secret),
    /// A certificate of the configured authority.
    Certificate,
}

impl Policy {
    pub fn check<B>(&self, request: &http::Request<B>) -> Result<(), Status> {
        if request.uri().path().starts_with(OPEN) {
            return Ok(());
        }
        let certified = || Connection::of_http(request).is_some_and(|c| c.has_certificate());
        match self {
            Policy::Open => Ok(()),
            Policy::Certificate if certified() => Ok(()),
            Policy::Certificate => Err(Status::unauthenticated("a client certificate is needed")),
            Policy::Token(token) => match request.headers().get(AUTHORIZATION) {
                Some(entry) => match bearer(entry.as_bytes()) {
                    Some(offered) if token.matches(offered) => Ok(()),
                    Some(_) => Err(Status::unauthenticated("authorization: the token is not the server's")),
                    None => Err(Status::unauthenticated("authorization: `Bearer <token>` is needed")),
                },
                None if certified() => Ok(()),
                None => Err(Status::unauthenticated("authorization: missing; `Bearer <token>` is needed")),
            },
        }
    }
}

fn bearer(entry: &[u8]) -> Option<&[u8]> {
    let (scheme, token) = entry.split_at_checked(7)?;
    scheme.eq_ignore_ascii_case(b"bearer ").then_some(token)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(policy: &Policy, path: &str, entry: Option<&str>) -> bool {
        let mut request = http::Request::builder().uri(path);
        if let Some(entry) = entry {
            request = request.header(AUTHORIZATION, entry);
        }
        policy.check(&request.body(()).unwrap()).is_ok()
    }

    #[test]
    fn a_token_must_be_shown_except_to_the_health_service() {
        let policy = Policy::Token(Secret::new("t0ken"));
        let path = "/coma.v1.Dpgo/Solve";
        assert!(checked(&policy, path, Some("Bearer t0ken")));
        assert!(checked(&policy, path, Some("bearer t0ken")));
        for wrong in ["t0ken", "Bearer", "Bearer t0ke", "Basic t0ken"] {
            assert!(!checked(&policy, path, Some(wrong)), "{wrong}");
        }
        assert!(!checked(&policy, path, None));
        assert!(checked(&policy, "/grpc.health.v1.Health/Check", None));
        assert!(!checked(&Policy::Certificate, path, Some("Bearer t0ken")));
    }
}
