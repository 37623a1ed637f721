//! coma-place-recognition
