//! coma-dataset
