//! coma-place
