//! coma-tests
