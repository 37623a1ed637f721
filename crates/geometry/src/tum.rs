//! Trajectories as text, in the form of the TUM RGB-D benchmark: `stamp tx ty tz qx qy qz qw` a line,
//! seconds, metres, Hamilton quaternion with the scalar last; `#` starts a comment.
//!
//! A stamp keeps its text, so that what was read is written back digit for digit.

use crate::{Pose, StampNs};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};

/// A pose at a time.
#[derive(Clone, Debug, PartialEq)]
pub struct StampedPose {
    /// Seconds, as the input wrote them.
    pub stamp_text: String,
    /// The same in nanoseconds.
    pub stamp: StampNs,
    /// Where the camera was, `world_from_camera` or `map_from_camera`.
    pub pose: Pose,
}

/// Why a text is no trajectory; names the line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("line {line}: {reason}")]
pub struct TumError {
    /// Counted from 1.
    pub line: usize,
    /// What is wrong with it.
    pub reason: String,
}

/// Nanoseconds of a decimal number of seconds, exactly (digits beyond the ninth are cut). `None` if the
/// text is no such number or too large for 64 bits. Exponents (`1e3`) are read through `f64`.
pub fn stamp(text: &str) -> Option<StampNs> {
    if text.contains(['e', 'E']) {
        let seconds: f64 = text.parse().ok()?;
        return (seconds.abs() < 9e9).then(|| StampNs::from_seconds(seconds));
    }
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let all_digits = whole.bytes().chain(fraction.bytes()).all(|b| b.is_ascii_digit());
    if !all_digits || whole.len() + fraction.len() == 0 {
        return None;
    }
    let seconds: i64 = if whole.is_empty() { 0 } else { whole.parse().ok()? };
    let mut nanos = 0i64;
    for i in 0..9 {
        nanos = nanos * 10 + fraction.as_bytes().get(i).map_or(0, |b| (b - b'0') as i64);
    }
    let total = seconds.checked_mul(1_000_000_000)?.checked_add(nanos)?;
    Some(StampNs(if negative { -total } else { total }))
}

/// Decimal seconds of a stamp, exactly: [`stamp`] gives it back. For stamps whose own text is not known.
pub fn stamp_text(stamp: StampNs) -> String {
    let sign = if stamp.0 < 0 { "-" } else { "" };
    let nanos = stamp.0.unsigned_abs();
    format!("{sign}{}.{:09}", nanos / 1_000_000_000, nanos % 1_000_000_000)
}

/// Reads a trajectory. Lines keep their order; quaternions are normalised.
pub fn parse(text: &str) -> Result<Vec<StampedPose>, TumError> {
    let mut out = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or("").trim();
        if line.is_empty() {
            continue;
        }
        let error = |reason: String| TumError { line: index + 1, reason };
        let words: Vec<&str> = line.split([' ', '\t', ',']).filter(|w| !w.is_empty()).collect();
        if words.len() != 8 {
            return Err(error(format!("{} values instead of 8 (stamp tx ty tz qx qy qz qw)", words.len())));
        }
        let stamp = stamp(words[0]).ok_or_else(|| error(format!("{:?} is no stamp in seconds", words[0])))?;
        let mut values = [0.0f64; 7];
        for (value, word) in values.iter_mut().zip(&words[1..]) {
            *value = word
                .parse()
                .ok()
                .filter(|v: &f64| v.is_finite())
                .ok_or_else(|| error(format!("{word:?} is no finite number")))?;
        }
        let [tx, ty, tz, qx, qy, qz, qw] = values;
        let rotation = UnitQuaternion::try_new(Quaternion::new(qw, qx, qy, qz), 1e-6)
            .ok_or_else(|| error("the quaternion is zero".into()))?;
        let pose = Pose::from_parts(Translation3::new(tx, ty, tz), rotation);
        out.push(StampedPose { stamp_text: words[0].to_owned(), stamp, pose });
    }
    Ok(out)
}

/// Writes one line, without a line break.
pub fn format_line(stamp_text: &str, pose: &Pose) -> String {
    let (t, q) = (&pose.translation.vector, &pose.rotation.coords);
    format!("{stamp_text} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}", t.x, t.y, t.z, q.x, q.y, q.z, q.w)
}

/// Writes a trajectory.
pub fn format<'a>(poses: impl IntoIterator<Item = (&'a str, &'a Pose)>) -> String {
    let mut text = String::from("# timestamp tx ty tz qx qy qz qw\n");
    for (stamp_text, pose) in poses {
        text.push_str(&format_line(stamp_text, pose));
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::se3;

    #[test]
    fn stamps_are_read_to_the_nanosecond() {
        assert_eq!(stamp("1305031102.175304"), Some(StampNs(1_305_031_102_175_304_000)));
        assert_eq!(stamp("-0.5"), Some(StampNs(-500_000_000)));
        assert_eq!(stamp(".25"), Some(StampNs(250_000_000)));
        assert_eq!(stamp("7"), Some(StampNs(7_000_000_000)));
        assert_eq!(stamp("1.5e1"), Some(StampNs(15_000_000_000)));
        for bad in ["", "-", ".", "nan", "1.2.3", "99999999999999999999", "0x1", "1 2"] {
            assert_eq!(stamp(bad), None, "{bad:?}");
        }
    }

    #[test]
    fn stamps_are_written_to_the_nanosecond() {
        for (nanos, text) in
            [(1_305_031_102_175_304_000, "1305031102.175304000"), (-1, "-0.000000001"), (0, "0.000000000")]
        {
            assert_eq!(stamp_text(StampNs(nanos)), text);
        }
        for nanos in [i64::MAX, -i64::MAX, 999_999_999, -1_000_000_001] {
            assert_eq!(stamp(&stamp_text(StampNs(nanos))), Some(StampNs(nanos)));
        }
        assert_eq!(stamp_text(StampNs(i64::MIN)), "-9223372036.854775808");
    }

    #[test]
    fn a_trajectory_survives_writing_and_reading_with_its_stamps_digit_for_digit() {
        let pose = se3::exp(&crate::Tangent::new(0.3, -1.0, 2.0, 0.4, 2.0, -1.0));
        let text = format([("0.100", &pose), ("0.2000000", &Pose::identity())]);
        let read = parse(&text).unwrap();
        assert_eq!(read[0].stamp_text, "0.100");
        assert_eq!(read[1].stamp_text, "0.2000000");
        let (metres, radians) = se3::distance(&read[0].pose, &pose);
        assert!(metres < 1e-8 && radians < 1e-8);
    }

    #[test]
    fn a_bad_line_is_named() {
        assert_eq!(parse("# c\n1 0 0 0 0 0 0 1\n2 0 0 0\n").unwrap_err().line, 3);
        assert!(parse("1 0 0 x 0 0 0 1").unwrap_err().reason.contains("\"x\""));
        assert!(parse("1 0 0 0 0 0 0 0").unwrap_err().reason.contains("quaternion"));
        assert!(parse("1 0 0 nan 0 0 0 1").is_err());
    }
}
