//! coma-encoder
