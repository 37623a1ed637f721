//! What scenarios of the cluster are told with; the scenarios themselves are below `tests/`.

pub mod story;
