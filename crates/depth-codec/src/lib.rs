//! coma-depth-codec
