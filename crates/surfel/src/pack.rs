//! Packing to at most 24 bytes a surfel.
