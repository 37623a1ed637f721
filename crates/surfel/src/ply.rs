//! Binary PLY in the layout of 3D Gaussian Splatting, which splat viewers open.
//!
//! Vertices have the float properties `x y z nx ny nz f_dc_0..2 opacity scale_0..2 rot_0..3`: colour as the
//! zeroth spherical harmonic, opacity before its sigmoid, scales as natural logarithms, rotation `w x y z`.
//! A surfel is a Gaussian whose third scale, along the normal, is 1 micrometre.

use crate::{Surfel, SurfelCloud};
use std::collections::HashMap;
use std::io::{self, BufRead, ErrorKind, Read, Write};

/// Names of the properties that are written, in order.
pub const PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1",
    "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
];
/// The third scale: a disc has no thickness, and viewers take logarithms.
pub const NORMAL_SCALE_M: f32 = 1e-6;
/// Bytes of a header that are looked at.
const MAX_HEADER_BYTES: u64 = 64 << 10;
/// The constant of the zeroth spherical harmonic, 1 / (2 sqrt(pi)).
const SH_C0: f32 = 0.282_094_8;
/// Opacity is kept this far from 0 and 1, where its logit is infinite.
const OPACITY_MARGIN: f32 = 1e-6;

/// Why bytes are no such file; names the part.
#[derive(Debug, thiserror::Error)]
pub enum PlyError {
    /// They could not be read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The header, with its line.
    #[error("header, line {line}: {message}")]
    Header {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        message: String,
    },
    /// A property that is needed is not there.
    #[error("property {name} is missing or no float")]
    Property {
        /// Which.
        name: &'static str,
    },
    /// More than the reader takes.
    #[error("element vertex: {count} vertices, at most {max} are taken")]
    TooMany {
        /// What the header says.
        count: usize,
        /// What is taken.
        max: usize,
    },
    /// Cut off.
    #[error("body: ends within vertex {index} of {count}")]
    Length {
        /// Counted from 0.
        index: usize,
        /// What the header says.
        count: usize,
    },
    /// A vertex that is no surfel.
    #[error("vertex {index}: a value is not finite, or its rotation is zero")]
    Vertex {
        /// Counted from 0.
        index: usize,
    },
}

/// Writes surfels. Those with a value that is not finite are left out: viewers choke on them.
pub fn write(surfels: &SurfelCloud, out: impl Write) -> io::Result<()> {
    let finite = || surfels.iter().filter(Surfel::is_finite);
    let mut writer = Writer::new(out, finite().count())?;
    finite().try_for_each(|surfel| writer.push(&surfel))?;
    writer.finish()
}

/// As [`write`], in memory.
pub fn to_bytes(surfels: &SurfelCloud) -> Vec<u8> {
    let mut out = Vec::with_capacity(1024 + surfels.len() * PROPERTIES.len() * 4);
    match write(surfels, &mut out) {
        Ok(()) => out,
        Err(_) => unreachable!("a vector takes all bytes"),
    }
}

/// Writes surfels one after the other.
pub struct Writer<W> {
    out: W,
    missing: usize,
}

impl<W: Write> Writer<W> {
    /// A file of `count` surfels, each written on its own: a file wants a buffer around it.
    pub fn new(mut out: W, count: usize) -> io::Result<Self> {
        write!(out, "ply\nformat binary_little_endian 1.0\ncomment CoMA surfels\nelement vertex {count}\n")?;
        for name in PROPERTIES {
            writeln!(out, "property float {name}")?;
        }
        writeln!(out, "end_header")?;
        Ok(Writer { out, missing: count })
    }

    /// Writes one with finite values; fails after the last.
    pub fn push(&mut self, surfel: &Surfel) -> io::Result<()> {
        let missing = self.missing.checked_sub(1);
        self.missing = missing.ok_or_else(|| io::Error::other("more surfels than the header says"))?;
        self.out.write_all(values(surfel).map(f32::to_le_bytes).as_flattened())
    }

    /// Flushes; fails when some are missing.
    pub fn finish(mut self) -> io::Result<()> {
        if self.missing > 0 {
            return Err(io::Error::other(format!("{} surfels fewer than the header says", self.missing)));
        }
        self.out.flush()
    }
}

/// Reads at most `max_surfels` from a binary little-endian file with at least the properties that are written
/// (normals aside), in any order and among others. The third scale is dropped. Memory is taken for as many as the header
/// says.
pub fn read(mut input: impl BufRead, max_surfels: usize) -> Result<SurfelCloud, PlyError> {
    let header = read_header(&mut input)?;
    if header.count > max_surfels {
        return Err(PlyError::TooMany { count: header.count, max: max_surfels });
    }
    let at = |name: &'static str| header.floats.get(name).copied().ok_or(PlyError::Property { name });
    let center = [at("x")?, at("y")?, at("z")?];
    let color = [at("f_dc_0")?, at("f_dc_1")?, at("f_dc_2")?];
    let scale = [at("scale_0")?, at("scale_1")?];
    let opacity = at("opacity")?;
    let rotation = [at("rot_0")?, at("rot_1")?, at("rot_2")?, at("rot_3")?];
    let mut vertex = vec![0; header.stride];
    let mut out = SurfelCloud::with_capacity(header.count);
    for index in 0..header.count {
        input.read_exact(&mut vertex).map_err(|e| match e.kind() {
            ErrorKind::UnexpectedEof => PlyError::Length { index, count: header.count },
            _ => PlyError::Io(e),
        })?;
        let float =
            |at: usize| f32::from_le_bytes([vertex[at], vertex[at + 1], vertex[at + 2], vertex[at + 3]]);
        let quaternion = rotation.map(float);
        let norm = quaternion.iter().map(|v| v * v).sum::<f32>().sqrt();
        let surfel = Surfel {
            center_m: center.map(float),
            rotation_wxyz: quaternion.map(|v| v / norm),
            scale_m: scale.map(|at| float(at).exp()),
            opacity: 1.0 / (1.0 + (-float(opacity)).exp()),
            color: color.map(|at| float(at) * SH_C0 + 0.5),
        };
        if !surfel.is_finite() {
            return Err(PlyError::Vertex { index });
        }
        out.push(surfel);
    }
    Ok(out)
}

fn values(surfel: &Surfel) -> [f32; 17] {
    let [x, y, z] = surfel.center_m;
    let normal = surfel.rotation().column(2).into_owned();
    let [r, g, b] = surfel.color.map(|c| (c - 0.5) / SH_C0);
    let opacity = surfel.opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    let [s0, s1] = surfel.scale_m.map(|s| s.max(NORMAL_SCALE_M).ln());
    let [qw, qx, qy, qz] = surfel.rotation_wxyz;
    let logit = (opacity / (1.0 - opacity)).ln();
    [x, y, z, normal.x, normal.y, normal.z, r, g, b, logit, s0, s1, NORMAL_SCALE_M.ln(), qw, qx, qy, qz]
}

struct Header {
    count: usize,
    /// Bytes of one vertex.
    stride: usize,
    /// Offsets of float properties within a vertex.
    floats: HashMap<String, usize>,
}

fn read_header(input: &mut impl BufRead) -> Result<Header, PlyError> {
    let mut head = input.take(MAX_HEADER_BYTES);
    let mut header = Header { count: 0, stride: 0, floats: HashMap::new() };
    let mut elements = 0;
    let mut formatted = false;
    let mut line = 0;
    loop {
        line += 1;
        let refuse = |message: &str| PlyError::Header { line, message: message.into() };
        let mut bytes = Vec::new();
        head.read_until(b'\n', &mut bytes)?;
        if bytes.pop() != Some(b'\n') {
            return Err(refuse("no end_header"));
        }
        let text = std::str::from_utf8(&bytes).map_err(|_| refuse("is no text"))?;
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        match words[..] {
            ["ply"] if line == 1 => {}
            _ if line == 1 => return Err(refuse("is not `ply`")),
            ["format", "binary_little_endian", "1.0"] => formatted = true,
            ["format", ..] => return Err(refuse("only binary_little_endian 1.0 is read")),
            ["comment" | "obj_info", ..] | [] => {}
            ["element", "vertex", count] if elements == 0 => {
                header.count = count.parse().map_err(|_| refuse("the count is no number"))?;
                elements += 1;
            }
            ["element", ..] if elements == 0 => return Err(refuse("vertices must come first")),
            ["element", ..] => elements += 1,
            // Elements after the vertices are not looked at.
            ["property", ..] if elements > 1 => {}
            ["property", kind, name] if elements == 1 => {
                let size = match kind {
                    "char" | "uchar" | "int8" | "uint8" => 1,
                    "short" | "ushort" | "int16" | "uint16" => 2,
                    "int" | "uint" | "int32" | "uint32" | "float" | "float32" => 4,
                    "double" | "float64" => 8,
                    _ => return Err(refuse("vertices have numbers only")),
                };
                if matches!(kind, "float" | "float32") {
                    header.floats.insert(name.to_owned(), header.stride);
                }
                header.stride += size;
            }
            ["end_header"] if formatted && header.stride > 0 => return Ok(header),
            ["end_header"] => return Err(refuse("the format or the vertices' properties are missing")),
            _ => return Err(refuse("is not understood")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> SurfelCloud {
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let surfel = Surfel {
            center_m: [1.0, -2.0, 3.0],
            rotation_wxyz: [half, half, 0.0, 0.0],
            scale_m: [0.01, 0.02],
            opacity: 0.75,
            color: [0.1, 0.2, 0.9],
        };
        [surfel, Surfel { center_m: [0.5; 3], opacity: 1.0, ..surfel }].into_iter().collect()
    }

    #[test]
    fn surfels_come_back() {
        let after = read(&to_bytes(&cloud())[..], 2).unwrap();
        for (a, b) in cloud().iter().zip(after.iter()) {
            assert_eq!(a.center_m, b.center_m);
            let close = |x: &[f32], y: &[f32]| x.iter().zip(y).all(|(x, y)| (x - y).abs() < 2e-6);
            assert!(
                close(&a.rotation_wxyz, &b.rotation_wxyz) && close(&a.scale_m, &b.scale_m),
                "{a:?} {b:?}"
            );
            assert!(close(&[a.opacity], &[b.opacity]) && close(&a.color, &b.color), "{a:?} {b:?}");
        }
    }

    #[test]
    fn the_layout_is_that_of_3d_gaussian_splatting_with_a_flat_third_scale() {
        let bytes = to_bytes(&cloud());
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = std::str::from_utf8(&bytes[..end]).unwrap();
        assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n"), "{header}");
        let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
        assert_eq!(names, PROPERTIES);
        assert_eq!(bytes.len() - end, 2 * 17 * 4);
        let value = |i: usize| f32::from_le_bytes(bytes[end + 4 * i..end + 4 * i + 4].try_into().unwrap());
        assert_eq!(value(12), 1e-6f32.ln());
        // A quarter turn about x takes the normal from z to -y.
        assert!((value(4) + 1.0).abs() < 1e-6 && value(5).abs() < 1e-6);
        // Opacity 0.75 is sigmoid(ln 3).
        assert!((value(9) - 3f32.ln()).abs() < 1e-6);
    }

    #[test]
    fn properties_may_come_in_any_order_among_others() {
        let mut header =
            String::from("ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty uchar tag\n");
        let mut body = vec![7u8];
        for name in PROPERTIES.iter().rev() {
            header.push_str(&format!("property double before_{name}\nproperty float32 {name}\n"));
            body.extend_from_slice(&9f64.to_le_bytes());
            let value: f32 = if *name == "rot_0" { 2.0 } else { 0.0 };
            body.extend_from_slice(&value.to_le_bytes());
        }
        header.push_str("element face 0\nproperty list uchar int vertex_indices\nend_header\n");
        let read = read(&[header.as_bytes(), &body].concat()[..], 1).unwrap();
        assert_eq!(read.rotation_wxyz, [[1.0, 0.0, 0.0, 0.0]]);
        assert_eq!((read.opacity[0], read.color[0], read.scale_m[0]), (0.5, [0.5; 3], [1.0; 2]));
    }

    #[test]
    fn what_is_no_such_file_is_refused_by_name() {
        let bytes = to_bytes(&cloud());
        for end in 0..bytes.len() {
            assert!(read(&bytes[..end], 2).is_err(), "{end}");
        }
        assert!(matches!(read(&bytes[..], 1), Err(PlyError::TooMany { count: 2, max: 1 })));
        assert!(matches!(read(&bytes[..bytes.len() - 1], 2), Err(PlyError::Length { index: 1, count: 2 })));
        let with = |from: &str, to: &str| {
            let text: Vec<u8> = bytes.clone();
            let at = text.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            let changed = [&text[..at], to.as_bytes(), &text[at + from.len()..]].concat();
            read(&changed[..], 2).unwrap_err()
        };
        assert!(matches!(with("float opacity", "float opacitx"), PlyError::Property { name: "opacity" }));
        assert!(matches!(with("binary_little", "binary_big123"), PlyError::Header { line: 2, .. }));
        assert!(matches!(with("vertex 2", "vertex -"), PlyError::Header { line: 4, .. }));
        let mut bad = bytes.clone();
        let end = bad.len();
        bad[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(matches!(read(&bad[..], 2), Err(PlyError::Vertex { index: 1 })));
    }

    #[test]
    fn surfels_that_are_not_finite_are_left_out() {
        let mut surfels = cloud();
        surfels.scale_m[0][1] = f32::NAN;
        assert_eq!(read(&to_bytes(&surfels)[..], 2).unwrap().len(), 1);
    }

    #[test]
    fn a_writer_takes_as_many_as_its_header_says() {
        let mut bytes = Vec::new();
        let mut writer = Writer::new(&mut bytes, 1).unwrap();
        writer.push(&cloud().get(0)).unwrap();
        assert!(writer.push(&cloud().get(1)).unwrap_err().to_string().contains("more surfels"));
        writer.finish().unwrap();
        assert_eq!(read(&bytes[..], 1).unwrap().len(), 1);
        assert!(Writer::new(Vec::new(), 1).unwrap().finish().is_err());
    }
}
