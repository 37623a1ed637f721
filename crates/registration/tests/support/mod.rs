//! Reads frames and poses of a TUM-layout sequence for the tests that need real data.

use coma_frame::{DepthNoise, Image};
use coma_geometry::nalgebra::{Quaternion, Translation3, UnitQuaternion};
use coma_geometry::{Intrinsics, Pose};
use coma_registration::View;
use std::path::{Path, PathBuf};

/// The folder `shared`: `COMA_SHARED`, or beside the repository.
pub fn shared() -> PathBuf {
    if let Some(folder) = std::env::var_os("COMA_SHARED") {
        return folder.into();
    }
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .ancestors()
        .map(|folder| folder.join("shared"))
        .find(|shared| shared.join("data").is_dir())
        .expect("no shared/data beside the repository and COMA_SHARED is not set")
}

pub struct Sequence {
    folder: PathBuf,
    rows: Vec<(String, String)>,
    pub map_from_camera: Vec<Pose>,
    camera: Intrinsics,
    units_per_m: f64,
}

impl Sequence {
    pub fn open(folder: &Path) -> Self {
        let lines = |name: &str| -> Vec<Vec<String>> {
            std::fs::read_to_string(folder.join(name))
                .unwrap()
                .lines()
                .filter(|l| !l.starts_with('#') && !l.trim().is_empty())
                .map(|l| l.split_whitespace().map(str::to_owned).collect())
                .collect()
        };
        let number = |text: &String| text.parse::<f64>().unwrap();
        let c: Vec<f64> = lines("calibration.txt")[0].iter().map(number).collect();
        let camera =
            Intrinsics { width: c[0] as u32, height: c[1] as u32, fx: c[2], fy: c[3], cx: c[4], cy: c[5] };
        let truth: Vec<Vec<f64>> =
            lines("groundtruth.txt").iter().map(|l| l.iter().map(number).collect()).collect();
        let associations = lines("associations.txt");
        let map_from_camera = associations
            .iter()
            .map(|row| {
                let stamp = number(&row[0]);
                let p = truth
                    .iter()
                    .min_by(|a, b| (a[0] - stamp).abs().total_cmp(&(b[0] - stamp).abs()))
                    .unwrap();
                let rotation = UnitQuaternion::from_quaternion(Quaternion::new(p[7], p[4], p[5], p[6]));
                Pose::from_parts(Translation3::new(p[1], p[2], p[3]), rotation)
            })
            .collect();
        let rows = associations.into_iter().map(|r| (r[1].clone(), r[3].clone())).collect();
        Sequence { folder: folder.into(), rows, map_from_camera, camera, units_per_m: c[6] }
    }

    pub fn view(&self, frame: usize) -> View {
        let (color, depth) = &self.rows[frame];
        let color = image::open(self.folder.join(color)).unwrap().to_rgb8();
        let depth = image::open(self.folder.join(depth)).unwrap().to_luma16();
        let (w, h) = (color.width() as usize, color.height() as usize);
        let color = Image::from_pixels(w, h, color.pixels().map(|p| p.0).collect()).unwrap();
        let metres = depth.pixels().map(|p| (p.0[0] as f64 / self.units_per_m) as f32).collect();
        View {
            depth_m: Image::from_pixels(w, h, metres).unwrap(),
            intensity: color.luminance(),
            camera: self.camera,
            noise: DepthNoise::default(),
        }
    }

    pub fn target_from_source(&self, source: usize, target: usize) -> Pose {
        self.map_from_camera[target].inv_mul(&self.map_from_camera[source])
    }
}
