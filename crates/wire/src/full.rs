//! A store that is full, told from a server that is busy: both are `RESOURCE_EXHAUSTED`, but waiting helps only
//! with the second. The first carries a `google.rpc.QuotaFailure`.

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, QuotaViolation, StatusExt};

/// `RESOURCE_EXHAUSTED`: `subject` (an index, a graph) holds what it may; `message` has the numbers and the setting.
pub fn full(subject: &str, message: &str) -> Status {
    let violation = QuotaViolation {
        subject: subject.to_owned(),
        description: message.to_owned(),
        ..QuotaViolation::default()
    };
    let details = ErrorDetails::with_quota_failure(vec![violation]);
    Status::with_error_details(Code::ResourceExhausted, message, details)
}

/// True for what [`full`] made: trying again changes nothing.
pub fn is_full(status: &Status) -> bool {
    status.code() == Code::ResourceExhausted
        && status.get_details_quota_failure().is_some_and(|quota| !quota.violations.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_store_and_a_busy_server_are_told_apart() {
        let status = full("index \"a\"", "index \"a\" is full: max_anchors_per_index = 3");
        assert!(is_full(&status) && status.message().contains("max_anchors_per_index"));
        assert!(!is_full(&Status::resource_exhausted("256 calls are under work")));
        assert!(!is_full(&Status::unavailable("gone")));
    }
}
