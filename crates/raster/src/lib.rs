//! coma-raster
