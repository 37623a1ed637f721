//! coma-viewer-gateway
