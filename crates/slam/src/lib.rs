//! coma-slam

pub mod log;
