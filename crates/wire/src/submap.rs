//! A submap's surfels come in pieces.

use crate::v1;
use bytes::{Bytes, BytesMut};
use coma_geometry::SubmapId;
use tonic::{Status, Streaming};

/// Reads a `Viewer.GetSubmap` to its end: the surfels' revision, and as they were packed, at most `max_bytes`.
pub async fn packed_surfels(
    mut stream: Streaming<v1::GetSubmapResponse>,
    id: &SubmapId,
    max_bytes: usize,
) -> Result<(u64, Bytes), Status> {
    let mut packed = BytesMut::new();
    let mut revision = 0;
    while let Some(message) = stream.message().await? {
        if packed.len() + message.chunk.len() > max_bytes {
            let text = format!("submap {id} has more than {max_bytes} bytes of surfels");
            return Err(Status::resource_exhausted(text));
        }
        packed.extend_from_slice(&message.chunk);
        revision = message.revision;
    }
    Ok((revision, packed.freeze()))
}
