//! coma-pose-graph
