//! coma-dpgo
