//! coma-wire
