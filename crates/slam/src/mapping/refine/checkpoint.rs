//! A job's whole state as bytes: a mark, the job's fingerprint, the state, and a checksum of all before it.

use super::adam::{Adam, PARAMETERS};
use super::densify::Seen;
use super::{RefineSettings, Refiner};
use coma_geometry::Pose;
use coma_surfel::{Surfel, SurfelCloud};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};

const MARK: &[u8; 16] = b"coma refine 1\n\0\0";
const HASH: usize = 32;
/// Step, number of surfels, number of views.
const COUNTS: usize = 12;
/// Bytes of a surfel: itself, its moments, what was seen of it.
const SURFEL: usize = 4 * (13 + 2 * PARAMETERS + 1 + 5);
/// Bytes of a pose.
const POSE: usize = 7 * 8;

/// Why bytes are no state of this job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CheckpointError {
    /// Another kind of file, or of another version.
    #[error("is no checkpoint that this version knows")]
    Mark,
    /// Cut off or changed.
    #[error("is torn: its checksum does not match")]
    Torn,
    /// Of a job with other settings, another map or other views.
    #[error("belongs to a job with other settings, another map or other views")]
    OtherJob,
}

/// Tells jobs apart: settings, surfels and views as they were at the start.
pub(super) fn fingerprint(
    settings: &RefineSettings,
    surfels: &SurfelCloud,
    fixed: &SurfelCloud,
    poses: &[Pose],
) -> [u8; HASH] {
    let mut bytes = Vec::new();
    for cloud in [surfels, fixed] {
        bytes.extend_from_slice(&(cloud.len() as u64).to_le_bytes());
        cloud.iter().for_each(|s| put_surfel(&mut bytes, &s));
    }
    poses.iter().for_each(|p| put_pose(&mut bytes, p));
    let mut hasher = blake3::Hasher::new();
    hasher.update(format!("{settings:?}\n").as_bytes());
    hasher.update(&bytes);
    *hasher.finalize().as_bytes()
}

pub(super) fn write(job: &Refiner) -> Vec<u8> {
    let mut out = Vec::with_capacity(
        MARK.len() + 2 * HASH + COUNTS + job.surfels.len() * SURFEL + job.poses.len() * POSE,
    );
    out.extend_from_slice(MARK);
    out.extend_from_slice(&job.fingerprint);
    for count in [job.step, job.surfels.len() as u32, job.poses.len() as u32] {
        out.extend_from_slice(&count.to_le_bytes());
    }
    for (i, surfel) in job.surfels.iter().enumerate() {
        put_surfel(&mut out, &surfel);
        put(&mut out, &job.adam.first[i]);
        put(&mut out, &job.adam.second[i]);
        out.extend_from_slice(&job.adam.steps[i].to_le_bytes());
        let Seen { weight, color, depth_m, px } = job.seen[i];
        put(&mut out, &[weight, color, depth_m, px[0], px[1]]);
    }
    job.poses.iter().for_each(|p| put_pose(&mut out, p));
    let checksum = blake3::hash(&out);
    out.extend_from_slice(checksum.as_bytes());
    out
}

pub(super) fn read(job: &mut Refiner, bytes: &[u8]) -> Result<(), CheckpointError> {
    if !bytes.starts_with(MARK) {
        return Err(if MARK.starts_with(bytes) { CheckpointError::Torn } else { CheckpointError::Mark });
    }
    let head = MARK.len() + HASH + COUNTS;
    if bytes.len() < head + HASH {
        return Err(CheckpointError::Torn);
    }
    let (body, checksum) = bytes.split_at(bytes.len() - HASH);
    if blake3::hash(body).as_bytes() != checksum {
        return Err(CheckpointError::Torn);
    }
    if body[MARK.len()..MARK.len() + HASH] != job.fingerprint {
        return Err(CheckpointError::OtherJob);
    }
    let mut from = Reader(&body[MARK.len() + HASH..]);
    let [step, surfels, views] = [from.u32(), from.u32(), from.u32()];
    if from.0.len() != surfels as usize * SURFEL + views as usize * POSE || views as usize != job.poses.len()
    {
        return Err(CheckpointError::Torn);
    }
    let (mut cloud, mut adam, mut seen) = (SurfelCloud::default(), Adam::default(), Vec::new());
    for _ in 0..surfels {
        cloud.push(Surfel {
            center_m: from.floats(),
            rotation_wxyz: from.floats(),
            scale_m: from.floats(),
            opacity: from.floats::<1>()[0],
            color: from.floats(),
        });
        adam.first.push(from.floats());
        adam.second.push(from.floats());
        adam.steps.push(from.u32());
        let [weight, color, depth_m, u, v] = from.floats();
        seen.push(Seen { weight, color, depth_m, px: [u, v] });
    }
    job.poses = (0..views).map(|_| from.pose()).collect();
    (job.step, job.surfels, job.adam, job.seen) = (step, cloud, adam, seen);
    Ok(())
}

fn put(out: &mut Vec<u8>, values: &[f32]) {
    values.iter().for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
}

fn put_surfel(out: &mut Vec<u8>, surfel: &Surfel) {
    put(out, &surfel.center_m);
    put(out, &surfel.rotation_wxyz);
    put(out, &surfel.scale_m);
    put(out, &[surfel.opacity]);
    put(out, &surfel.color);
}

fn put_pose(out: &mut Vec<u8>, pose: &Pose) {
    let (t, q) = (pose.translation.vector, pose.rotation.coords);
    for value in [t.x, t.y, t.z, q.x, q.y, q.z, q.w] {
        out.extend_from_slice(&value.to_le_bytes());
    }
}

/// Reads what [`write`] wrote; the length was checked before.
struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let mut out = [0; N];
        let (head, tail) = self.0.split_at(N.min(self.0.len()));
        out[..head.len()].copy_from_slice(head);
        self.0 = tail;
        out
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    fn floats<const N: usize>(&mut self) -> [f32; N] {
        std::array::from_fn(|_| f32::from_le_bytes(self.take()))
    }

    fn pose(&mut self) -> Pose {
        let [x, y, z, qx, qy, qz, qw]: [f64; 7] = std::array::from_fn(|_| f64::from_le_bytes(self.take()));
        // As it was, to the last bit.
        let rotation = UnitQuaternion::new_unchecked(Quaternion::new(qw, qx, qy, qz));
        Pose::from_parts(Translation3::new(x, y, z), rotation)
    }
}
