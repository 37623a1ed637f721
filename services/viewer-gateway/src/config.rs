//! Settings of the gateway.

use coma_runtime::{ClientSettings, Secret};
use serde::Deserialize;
use std::net::SocketAddr;

/// Settings of the gateway; every one has a default, and `COMA_GATEWAY__NAME=value` overrides the file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GatewayConfig {
    /// Address and port; port 0 takes a free one. Default: 127.0.0.1:8080.
    pub listen: SocketAddr,
    /// Callers must send `authorization: Bearer <token>`; agents are shown the same one unless `client.token`
    /// is set. Without one, only loopback is open.
    pub token: Option<Secret>,
    /// Listen beyond loopback without a token. Default: no.
    pub insecure: bool,
    /// Endpoints of agents, e.g. `http://robot-1:7001`.
    pub agents: Vec<String>,
    /// A name and port that DNS answers with the addresses of all agents, e.g. `agent:7001`; with `https://`
    /// before it, agents are called over TLS. Asked again and again.
    pub agents_dns: Option<String>,
    /// Seconds between two questions to DNS. Default: 2.
    pub dns_every_s: f64,
    /// Seconds between two questions for an agent's status. Default: 1.
    pub status_every_s: f64,
    /// An agent that does not answer within so many seconds is unreachable. Default: 2.
    pub status_timeout_s: f64,
    /// Longest time that one answer of an agent may take to the end, seconds. Default: 15.
    pub call_timeout_s: f64,
    /// How agents are called.
    pub client: ClientSettings,
    /// Bytes of closed submaps that are kept, by id and revision. Default: 512 MiB.
    pub cache_bytes: usize,
    /// Surfels that one map or one submap may have to be merged or rendered. Default: 8 million.
    pub max_surfels: usize,
    /// Poses that one agent's answer may have. Default: 1 million.
    pub max_poses: usize,
    /// Pixels of one rendering. Default: 1920 x 1200.
    pub max_render_pixels: usize,
    /// Renderings and merged maps under work at once; as many again wait. Default: 2.
    pub max_heavy: usize,
    /// Requests under work at once; more are refused with 503. Default: 256.
    pub max_requests: usize,
    /// Listeners to live events; more are refused with 503. Default: 64.
    pub max_listeners: usize,
}

impl Default for GatewayConfig {
    fn default() -> Self {
        GatewayConfig {
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            token: None,
            insecure: false,
            agents: Vec::new(),
            agents_dns: None,
            dns_every_s: 2.0,
            status_every_s: 1.0,
            status_timeout_s: 2.0,
            call_timeout_s: 15.0,
            client: ClientSettings::default(),
            cache_bytes: 512 << 20,
            max_surfels: 8_000_000,
            max_poses: 1_000_000,
            max_render_pixels: 1920 * 1200,
            max_heavy: 2,
            max_requests: 256,
            max_listeners: 64,
        }
    }
}

/// A setting out of range, or one that leaves the gateway open.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// Reachable from elsewhere, and nothing says who may call.
    #[error(
        "listen = {listen} is reachable from other machines, but token is not set; set it, or insecure = true \
         if the network is trusted"
    )]
    Open {
        /// The address.
        listen: SocketAddr,
    },
    /// An empty token is none.
    #[error("token is empty; leave it out, or set a secret")]
    EmptyToken,
    /// Out of range.
    #[error("{field} = {value} must be over 0 and at most {most}")]
    Range {
        /// Which.
        field: &'static str,
        /// Its value.
        value: f64,
        /// The most that is taken.
        most: f64,
    },
}

impl GatewayConfig {
    /// Checks what can be checked without the network. Agents' endpoints are checked when they are dialled.
    pub fn checked(mut self) -> Result<Self, ConfigError> {
        match &self.token {
            Some(token) if token.reveal().is_empty() => return Err(ConfigError::EmptyToken),
            None if !self.listen.ip().is_loopback() && !self.insecure => {
                return Err(ConfigError::Open { listen: self.listen });
            }
            _ => {}
        }
        for (field, value, most) in [
            ("dns_every_s", self.dns_every_s, 3600.0),
            ("status_every_s", self.status_every_s, 3600.0),
            ("status_timeout_s", self.status_timeout_s, 60.0),
            ("call_timeout_s", self.call_timeout_s, 600.0),
            ("max_surfels", self.max_surfels as f64, 1e9),
            ("max_poses", self.max_poses as f64, 1e8),
            ("max_render_pixels", self.max_render_pixels as f64, 8192.0 * 8192.0),
            ("max_heavy", self.max_heavy as f64, 1e4),
            ("max_requests", self.max_requests as f64, 1e6),
            ("max_listeners", self.max_listeners as f64, 1e6),
        ] {
            if !(value > 0.0 && value <= most) {
                return Err(ConfigError::Range { field, value, most });
            }
        }
        if self.client.token.is_none() {
            self.client.token = self.token.clone();
        }
        Ok(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beyond_loopback_a_token_or_a_word_is_needed() {
        let everywhere = GatewayConfig { listen: ([0, 0, 0, 0], 0).into(), ..Default::default() };
        let refused = |config: &GatewayConfig| config.clone().checked().unwrap_err().to_string();
        assert!(refused(&everywhere).contains("token"));
        let insecure = GatewayConfig { insecure: true, ..everywhere.clone() };
        assert!(insecure.checked().is_ok());
        let empty = GatewayConfig { token: Some(Secret::new("")), ..everywhere.clone() };
        assert!(refused(&empty).contains("empty"));
        let token = GatewayConfig { token: Some(Secret::new("t")), ..everywhere };
        assert_eq!(token.checked().unwrap().client.token.unwrap().reveal(), "t");
    }

    #[test]
    fn a_setting_out_of_range_is_named() {
        for (field, config) in [
            ("status_every_s", GatewayConfig { status_every_s: f64::NAN, ..Default::default() }),
            ("call_timeout_s", GatewayConfig { call_timeout_s: 0.0, ..Default::default() }),
            ("max_render_pixels", GatewayConfig { max_render_pixels: usize::MAX, ..Default::default() }),
        ] {
            assert!(config.checked().unwrap_err().to_string().starts_with(field));
        }
    }
}
