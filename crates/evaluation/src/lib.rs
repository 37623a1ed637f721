//! coma-evaluation
