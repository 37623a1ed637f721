//! A viewpoint and what is seen from it, as a picture file.

use crate::scene::Placed;
use coma_frame::Image;
use coma_geometry::{Intrinsics, Pose};
use coma_raster::{RenderSettings, Rendering, SubmapView};
use image::{ExtendedColorType, ImageEncoder, ImageError};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What a picture shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Output {
    /// Blended colour over black.
    #[default]
    Color,
    /// The depth, along z, at which half of the light is blocked. PNG: 16 bits, millimetres, 0 where there is
    /// none. JPEG: 8 bits for looking at, from 255 (nearest) to 32 (farthest), 0 where there is none.
    Depth,
    /// Normals in the camera: red, green, blue are x (right), -y (up), -z (towards the camera), -1 to 1 as 0 to
    /// 255; black where there is none.
    Normal,
}

/// How a picture is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// Without loss.
    #[default]
    Png,
    /// Smaller.
    Jpeg,
}

impl Format {
    /// For `content-type`.
    pub fn media_type(self) -> &'static str {
        match self {
            Format::Png => "image/png",
            Format::Jpeg => "image/jpeg",
        }
    }
}

/// Quality of JPEG.
const QUALITY: u8 = 90;

/// Renders submaps from a viewpoint and encodes the picture.
pub fn picture(
    parts: &[Placed],
    map_from_camera: &Pose,
    camera: &Intrinsics,
    output: Output,
    format: Format,
) -> Result<Vec<u8>, ImageError> {
    let camera_from_map = map_from_camera.inverse();
    let view = |(map_from_submap, surfels): &'_ Placed| (camera_from_map * map_from_submap, surfels.clone());
    let placed: Vec<_> = parts.iter().map(view).collect();
    let views: Vec<SubmapView<'_>> = placed
        .iter()
        .map(|(camera_from_submap, surfels)| SubmapView::new(surfels, *camera_from_submap))
        .collect();
    let rendering = coma_raster::render(&views, camera, &RenderSettings::default(), None);
    encode(&rendering, output, format)
}

fn encode(rendering: &Rendering, output: Output, format: Format) -> Result<Vec<u8>, ImageError> {
    let depth = &rendering.median_depth_m;
    match (output, format) {
        (Output::Color, _) => {
            let pixels = rendering.color.pixels().iter().flat_map(|c| c.map(byte));
            write(&pixels.collect::<Vec<_>>(), depth, ExtendedColorType::Rgb8, format)
        }
        (Output::Normal, _) => {
            let pixels = rendering.normal.pixels().iter().flat_map(|[x, y, z]| match (x, y, z) {
                (0.0, 0.0, 0.0) => [0; 3],
                _ => [*x, -*y, -*z].map(|v| byte(0.5 * (v + 1.0))),
            });
            write(&pixels.collect::<Vec<_>>(), depth, ExtendedColorType::Rgb8, format)
        }
        (Output::Depth, Format::Png) => {
            let millimetres = |d: &f32| (d * 1000.0).round().clamp(0.0, 65535.0) as u16;
            let pixels: Vec<u8> = depth.pixels().iter().flat_map(|d| millimetres(d).to_ne_bytes()).collect();
            write(&pixels, depth, ExtendedColorType::L16, format)
        }
        (Output::Depth, Format::Jpeg) => {
            let hit = || depth.pixels().iter().copied().filter(|d| *d > 0.0);
            let (near, far) = (hit().fold(f32::INFINITY, f32::min), hit().fold(0.0, f32::max));
            let grey = |d: &f32| match *d > 0.0 {
                true => byte(1.0 - (d - near) / (far - near).max(1e-6) * (223.0 / 255.0)),
                false => 0,
            };
            let pixels: Vec<u8> = depth.pixels().iter().map(grey).collect();
            write(&pixels, depth, ExtendedColorType::L8, format)
        }
    }
}

fn byte(unit: f32) -> u8 {
    (unit.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn write(
    pixels: &[u8],
    size: &Image<f32>,
    kind: ExtendedColorType,
    format: Format,
) -> Result<Vec<u8>, ImageError> {
    let (width, height) = (size.width() as u32, size.height() as u32);
    let mut file = Vec::new();
    match format {
        Format::Png => {
            image::codecs::png::PngEncoder::new(&mut file).write_image(pixels, width, height, kind)?
        }
        Format::Jpeg => {
            let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, QUALITY);
            encoder.write_image(pixels, width, height, kind)?;
        }
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_surfel::{Surfel, SurfelCloud};
    use std::sync::Arc;

    const CAMERA: Intrinsics = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 };

    /// An orange wall that faces the camera of the submap, two metres away, and a submap that lies a metre
    /// behind the map's origin.
    fn wall() -> Placed {
        let surfel = |i: usize| Surfel {
            center_m: [0.1 * (i % 41) as f32 - 2.0, 0.1 * (i / 41) as f32 - 2.0, 2.0],
            rotation_wxyz: [0.0, 1.0, 0.0, 0.0],
            scale_m: [0.1, 0.1],
            opacity: 0.95,
            color: [1.0, 0.5, 0.0],
        };
        let surfels: SurfelCloud = (0..41 * 41).map(surfel).collect();
        (Pose::translation(0.0, 0.0, -1.0), Arc::new(surfels))
    }

    fn read(output: Output, format: Format) -> image::DynamicImage {
        let map_from_camera = Pose::translation(0.0, 0.0, -2.0);
        let file = picture(&[wall()], &map_from_camera, &CAMERA, output, format).unwrap();
        image::load_from_memory(&file).unwrap()
    }

    #[test]
    fn a_wall_has_its_colour_depth_and_normal() {
        let color = read(Output::Color, Format::Png).into_rgb8();
        assert_eq!((color.width(), color.height()), (32, 24));
        let [r, g, b] = color.get_pixel(16, 12).0;
        assert!(r > 245 && (120..=130).contains(&g) && b < 5, "{r} {g} {b}");
        let depth = read(Output::Depth, Format::Png);
        assert_eq!(depth.color(), image::ColorType::L16);
        let millimetres = depth.into_luma16().get_pixel(16, 12).0[0];
        // The wall is 1 m before the map's origin, the camera 2 m behind it.
        assert!((2990..=3010).contains(&millimetres), "{millimetres}");
        let [x, y, z] = read(Output::Normal, Format::Png).into_rgb8().get_pixel(16, 12).0;
        assert!(x.abs_diff(128) <= 1 && y.abs_diff(128) <= 1 && z >= 254, "{x} {y} {z}");
    }

    #[test]
    fn jpeg_says_the_same_for_looking_at() {
        let [r, g, b] = read(Output::Color, Format::Jpeg).into_rgb8().get_pixel(16, 12).0;
        assert!(r > 240 && g.abs_diff(127) < 10 && b < 15, "{r} {g} {b}");
        assert!(read(Output::Depth, Format::Jpeg).into_luma8().get_pixel(16, 12).0[0] > 20);
    }

    #[test]
    fn an_empty_map_is_black() {
        let file = picture(&[], &Pose::identity(), &CAMERA, Output::Normal, Format::Png).unwrap();
        assert!(image::load_from_memory(&file).unwrap().into_rgb8().pixels().all(|p| p.0 == [0; 3]));
    }
}
