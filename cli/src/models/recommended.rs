//! The manifest of the model to recommend: DINOv2 ViT-S/14 (Oquab et al. 2024), Apache 2.0, 21 million weights.

use coma_encoder::{Input, Manifest, Output, Pooling, Thresholds};

/// Its name.
pub const NAME: &str = "dinov2-vits14";

/// As common exports have it: `pixel_values` in, `last_hidden_state` with the CLS token and 256 patches of 384 values
/// out. Its patches are pooled by their generalised mean (Radenovic et al. 2019), which finds places again more often
/// than the CLS token does (AnyLoc, Keetha et al. 2023). The thresholds are low, for recall; `coma bench places` proposes better ones for a
/// place that is known.
pub fn manifest() -> Manifest {
    Manifest {
        model: format!("{NAME}.onnx").into(),
        sha256: None,
        input: Input {
            name: "pixel_values".into(),
            width: 224,
            height: 224,
            mean: [0.485, 0.456, 0.406],
            std: [0.229, 0.224, 0.225],
        },
        output: Output {
            name: "last_hidden_state".into(),
            dimension: 384,
            pooling: Pooling::Gem { power: 3.0, skip_tokens: 1 },
        },
        thresholds: Thresholds { theta_sim: 0.6, theta_multi: 0.6 },
    }
}
