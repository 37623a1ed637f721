//! coma-agent
