//! How long a call may take.

use http::HeaderMap;
use std::time::Duration;

/// Answers a little before the caller's own clock runs out, so that the caller reads DEADLINE_EXCEEDED
/// rather than a broken call.
const MARGIN: Duration = Duration::from_millis(5);

/// The caller's `grpc-timeout`, or the server's own limit if that is shorter.
pub(crate) fn time_left(headers: &HeaderMap, server_limit: Duration) -> Duration {
    match grpc_timeout(headers) {
        Some(asked) => asked.saturating_sub(MARGIN).min(server_limit),
        None => server_limit,
    }
}

/// At most eight digits and a unit, as the gRPC protocol has it.
fn grpc_timeout(headers: &HeaderMap) -> Option<Duration> {
    let text = headers.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if digits.len() > 8 {
        return None;
    }
    let value: u64 = digits.parse().ok()?;
    match unit {
        "H" => Some(Duration::from_secs(value * 3600)),
        "M" => Some(Duration::from_secs(value * 60)),
        "S" => Some(Duration::from_secs(value)),
        "m" => Some(Duration::from_millis(value)),
        "u" => Some(Duration::from_micros(value)),
        "n" => Some(Duration::from_nanos(value)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shorter_of_both_limits_holds() {
        let left = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert("grpc-timeout", text.parse().unwrap());
            time_left(&headers, Duration::from_secs(10))
        };
        assert_eq!(left("100m"), Duration::from_millis(95));
        assert_eq!(left("1H"), Duration::from_secs(10));
        assert_eq!(left("1n"), Duration::ZERO);
        for nonsense in ["", "x", "12", "123456789S", "-1S", "1é"] {
            let header = http::HeaderValue::from_bytes(nonsense.as_bytes()).unwrap();
            let headers = HeaderMap::from_iter([(http::HeaderName::from_static("grpc-timeout"), header)]);
            assert_eq!(time_left(&headers, Duration::from_secs(10)), Duration::from_secs(10), "{nonsense}");
        }
    }
}
