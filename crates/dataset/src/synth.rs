//! Writing sequences to disk.

use crate::{ColorBytes, DatasetError, DepthBytes, Sequence};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use std::fs;
use std::path::Path;

/// Writes a sequence in the TUM layout: rgb/, depth/ (PNG, 16 bit), associations.txt, rgb.txt, depth.txt,
/// calibration.txt, and groundtruth.txt where the sequence knows its poses. Encoded pictures are copied
/// as they are. `progress` gets the number of frames written so far.
///
/// The layout has one camera: a sequence whose depth isn't registered to colour, or whose lens is
/// distorted, is written as its decoded frames.
pub fn write_tum(
    sequence: &dyn Sequence,
    folder: &Path,
    progress: &mut dyn FnMut(usize),
) -> Result<(), DatasetError> {
    let calibration = sequence.calibration();
    let as_is = calibration.depth_is_registered() && calibration.color_distortion.is_none();
    for sub in ["rgb", "depth"] {
        let path = folder.join(sub);
        fs::create_dir_all(&path).map_err(|e| DatasetError::io(&path, e))?;
    }
    let mut associations = String::new();
    let (mut colors, mut depths) = (String::new(), String::new());
    let mut truth = Vec::new();
    for index in 0..sequence.len() {
        let stamp = sequence.stamp_text(index);
        let mut frame = sequence.frame(index)?;
        if !as_is {
            let decoded = frame.decode(calibration, index as u64, sequence.stamp(index))?;
            let units = calibration.depth_units_per_metre as f32;
            frame.depth = DepthBytes::Raw16(decoded.depth_m.map(|z| (z * units).round().min(65535.0) as u16));
            frame.color = ColorBytes::Rgb8(decoded.color);
        }
        let (color, ending) = match frame.color {
            ColorBytes::Jpeg(bytes) => (bytes, "jpg"),
            ColorBytes::Png(bytes) => (bytes, "png"),
            ColorBytes::Rgb8(image) => {
                let bytes: Vec<u8> = image.pixels().iter().flatten().copied().collect();
                (png(&bytes, image.width(), image.height(), ExtendedColorType::Rgb8, "color")?, "png")
            }
        };
        let depth = match frame.depth {
            DepthBytes::Png16(bytes) => bytes,
            DepthBytes::Raw16(image) => {
                let bytes: Vec<u8> = image.pixels().iter().flat_map(|v| v.to_ne_bytes()).collect();
                png(&bytes, image.width(), image.height(), ExtendedColorType::L16, "depth")?
            }
        };
        let (color_name, depth_name) = (format!("rgb/{stamp}.{ending}"), format!("depth/{stamp}.png"));
        write(&folder.join(&color_name), &color)?;
        write(&folder.join(&depth_name), &depth)?;
        associations.push_str(&format!("{stamp} {color_name} {stamp} {depth_name}\n"));
        colors.push_str(&format!("{stamp} {color_name}\n"));
        depths.push_str(&format!("{stamp} {depth_name}\n"));
        truth.extend(sequence.truth(index).map(|pose| (stamp, pose)));
        progress(index + 1);
    }
    write(&folder.join("associations.txt"), associations.as_bytes())?;
    write(&folder.join("rgb.txt"), colors.as_bytes())?;
    write(&folder.join("depth.txt"), depths.as_bytes())?;
    let c = &calibration.color;
    let line = format!(
        "# width height fx fy cx cy depth_units_per_metre\n{} {} {} {} {} {} {}\n",
        c.width, c.height, c.fx, c.fy, c.cx, c.cy, calibration.depth_units_per_metre
    );
    write(&folder.join("calibration.txt"), line.as_bytes())?;
    if !truth.is_empty() {
        let text = coma_geometry::tum::format(truth.iter().map(|(stamp, pose)| (*stamp, pose)));
        write(&folder.join("groundtruth.txt"), text.as_bytes())?;
    }
    Ok(())
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), DatasetError> {
    fs::write(path, bytes).map_err(|e| DatasetError::io(path, e))
}

fn png(
    bytes: &[u8],
    width: usize,
    height: usize,
    kind: ExtendedColorType,
    field: &'static str,
) -> Result<Vec<u8>, DatasetError> {
    let mut out = Vec::new();
    PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Adaptive)
        .write_image(bytes, width as u32, height as u32, kind)
        .map_err(|e| DatasetError::Picture { field, reason: e.to_string() })?;
    Ok(out)
}
