//! 3D Gaussians as values and as columns.

/// One Gaussian, in the frame of its submap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaussian {
    /// Centre, metres.
    pub center_m: [f32; 3],
    /// Its axes, a unit quaternion `w, x, y, z`.
    pub rotation_wxyz: [f32; 4],
    /// Standard deviations along its axes, metres.
    pub scale_m: [f32; 3],
    /// 0..1.
    pub opacity: f32,
    /// RGB, 0..1.
    pub color: [f32; 3],
}

/// Gaussians as columns; every column has the same length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GaussianCloud {
    /// Centres, metres. `[n, 3]`
    pub center_m: Vec<[f32; 3]>,
    /// Unit quaternions w, x, y, z. `[n, 4]`
    pub rotation_wxyz: Vec<[f32; 4]>,
    /// Standard deviations, metres. `[n, 3]`
    pub scale_m: Vec<[f32; 3]>,
    /// 0..1. `[n]`
    pub opacity: Vec<f32>,
    /// RGB, 0..1. `[n, 3]`
    pub color: Vec<[f32; 3]>,
}

impl GaussianCloud {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.center_m.len()
    }

    /// True without Gaussians.
    pub fn is_empty(&self) -> bool {
        self.center_m.is_empty()
    }

    /// Appends one.
    pub fn push(&mut self, gaussian: Gaussian) {
        self.center_m.push(gaussian.center_m);
        self.rotation_wxyz.push(gaussian.rotation_wxyz);
        self.scale_m.push(gaussian.scale_m);
        self.opacity.push(gaussian.opacity);
        self.color.push(gaussian.color);
    }

    /// The one at `index`.
    pub fn get(&self, index: usize) -> Gaussian {
        Gaussian {
            center_m: self.center_m[index],
            rotation_wxyz: self.rotation_wxyz[index],
            scale_m: self.scale_m[index],
            opacity: self.opacity[index],
            color: self.color[index],
        }
    }

    /// All, in order.
    pub fn iter(&self) -> impl Iterator<Item = Gaussian> + '_ {
        (0..self.len()).map(|i| self.get(i))
    }
}

impl FromIterator<Gaussian> for GaussianCloud {
    fn from_iter<I: IntoIterator<Item = Gaussian>>(gaussians: I) -> Self {
        let mut cloud = GaussianCloud::default();
        for gaussian in gaussians {
            cloud.push(gaussian);
        }
        cloud
    }
}
