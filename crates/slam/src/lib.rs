//! coma-slam
