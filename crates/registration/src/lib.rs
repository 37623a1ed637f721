//! coma-registration
