//! What registration needs of an anchor, as the blob that is named by its hash.

use crate::field::{At, FieldError, Wire};
use crate::v1;
use bytes::Bytes;
use coma_frame::DepthNoise;
use coma_geometry::Intrinsics;
use coma_slam::log::Evidence;
use prost::Message;

/// Compressed depth and a small intensity image of one anchor.
#[derive(Clone, Debug, PartialEq)]
pub struct EvidenceBlob {
    /// The camera of both images.
    pub camera: Intrinsics,
    /// How wrong the depth is.
    pub depth_noise: DepthNoise,
    /// CoMA's depth codec.
    pub depth: Bytes,
    /// JPEG or PNG, one channel, of the camera's size.
    pub intensity: Bytes,
}

impl Wire for EvidenceBlob {
    type Message = v1::EvidenceBlob;

    fn to_wire(&self) -> v1::EvidenceBlob {
        v1::EvidenceBlob {
            camera: Some(self.camera.to_wire()),
            depth_noise: Some(self.depth_noise.to_wire()),
            depth: self.depth.clone(),
            intensity: self.intensity.clone(),
        }
    }

    fn from_wire(m: v1::EvidenceBlob, at: &At<'_>) -> Result<Self, FieldError> {
        Ok(EvidenceBlob {
            camera: at.field("camera").required(m.camera)?,
            depth_noise: at.field("depth_noise").required(m.depth_noise)?,
            depth: m.depth,
            intensity: m.intensity,
        })
    }
}

/// The bytes of a blob and its name.
pub fn encode_evidence(blob: &EvidenceBlob) -> (Evidence, Bytes) {
    let bytes = Bytes::from(blob.to_wire().encode_to_vec());
    (Evidence { hash: *blake3::hash(&bytes).as_bytes(), size_bytes: bytes.len() as u64 }, bytes)
}

/// Checks that the bytes are those that `name` names, and reads them.
pub fn decode_evidence(name: &Evidence, bytes: Bytes) -> Result<EvidenceBlob, FieldError> {
    let at = At::Root("blob");
    if bytes.len() as u64 != name.size_bytes || *blake3::hash(&bytes).as_bytes() != name.hash {
        return Err(at.refuse(format!("{} bytes that are not what their name says", bytes.len())));
    }
    let message =
        v1::EvidenceBlob::decode(bytes).map_err(|e| at.refuse(format!("is no EvidenceBlob: {e}")))?;
    EvidenceBlob::from_wire(message, &at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evidence_is_what_its_name_says_or_refused() {
        let blob = EvidenceBlob {
            camera: Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5 },
            depth_noise: DepthNoise::default(),
            depth: vec![1, 2, 3].into(),
            intensity: vec![4].into(),
        };
        let (name, bytes) = encode_evidence(&blob);
        assert_eq!(decode_evidence(&name, bytes.clone()).unwrap(), blob);
        let mut forged = bytes.to_vec();
        *forged.last_mut().unwrap() ^= 1;
        assert_eq!(decode_evidence(&name, forged.into()).unwrap_err().field, "blob");
    }
}
