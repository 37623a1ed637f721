//! Times of another solver beside ours: what GTSAM took for the same sets, from a file of JSON lines.

use anyhow::Context;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// One record; those of other methods than `lm`, and those without times, are left out.
#[derive(Deserialize)]
struct Record {
    dataset: String,
    method: String,
    chordal_cpu_ms: Option<f64>,
    cpu_ms_median: Option<f64>,
}

/// Processor time of chordal initialisation and descent together, by set.
pub fn times_ms(path: &Path) -> anyhow::Result<BTreeMap<String, f64>> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let mut out = BTreeMap::new();
    for (number, line) in text.lines().enumerate().filter(|(_, line)| line.starts_with('{')) {
        let record: Record =
            serde_json::from_str(line).with_context(|| format!("{}: line {}", path.display(), number + 1))?;
        if let (true, Some(chordal), Some(descent)) =
            (record.method == "lm", record.chordal_cpu_ms, record.cpu_ms_median)
        {
            out.insert(record.dataset, chordal + descent);
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chordal_and_descent_of_lm_are_added_and_a_bad_line_is_named() {
        let path = std::env::temp_dir().join(format!("coma-against-{}.jsonl", std::process::id()));
        let good = r#"{"dataset": "torus3D", "method": "lm", "chordal_cpu_ms": 10.0, "cpu_ms_median": 5.5}
{"dataset": "torus3D", "method": "lm_fileinit", "chordal_cpu_ms": 10.0, "cpu_ms_median": 99.0}
{"dataset": "sphere2500", "method": "lm", "error": "none"}
"#;
        std::fs::write(&path, good).unwrap();
        assert_eq!(times_ms(&path).unwrap(), BTreeMap::from([("torus3D".into(), 15.5)]));
        std::fs::write(&path, "{\"dataset\": 3}").unwrap();
        assert!(format!("{:#}", times_ms(&path).unwrap_err()).contains("line 1"));
        std::fs::remove_file(&path).unwrap();
    }
}
