//! coma-store
