//! coma-runtime
