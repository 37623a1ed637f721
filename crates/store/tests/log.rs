//! The log: what it keeps, through crashes and damage.

use coma_store::{AppendLog, LogError, LogLimits, Recovery};
use proptest::prelude::*;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const SMALL: LogLimits = LogLimits { segment_bytes: 512, max_record_bytes: 256, max_batch_bytes: 1024 };

fn open(folder: &Path) -> AppendLog {
    AppendLog::open(folder, SMALL).unwrap()
}

fn contents(log: &AppendLog) -> Vec<Vec<u8>> {
    let records: Vec<_> = log.iter().map(Result::unwrap).collect();
    for (k, record) in records.iter().enumerate() {
        assert_eq!(record.index, k as u64);
    }
    records.into_iter().map(|record| record.bytes).collect()
}

fn record(k: usize) -> Vec<u8> {
    (0..k % 90).map(|i| (k * 31 + i * 7) as u8).collect()
}

fn segments(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

/// Copies a log's files into a new folder.
fn copy(folder: &Path) -> tempfile::TempDir {
    let copy = tempfile::tempdir().unwrap();
    for file in segments(folder) {
        std::fs::copy(&file, copy.path().join(file.file_name().unwrap())).unwrap();
    }
    copy
}

#[test]
fn records_come_back_in_order_over_segments_and_restarts() {
    let folder = tempfile::tempdir().unwrap();
    let expected: Vec<_> = (0..60).map(record).collect();
    for chunk in expected.chunks(13) {
        let mut log = open(folder.path());
        for (k, record) in chunk.iter().enumerate() {
            let at = log.len();
            if k % 3 == 0 {
                assert_eq!(log.append_batch(&[record]).unwrap(), at..at + 1);
            } else {
                assert_eq!(log.append(record).unwrap(), at);
            }
        }
    }
    let log = open(folder.path());
    assert_eq!(contents(&log), expected);
    assert_eq!(log.recovery(), &Recovery { records: 60, torn_bytes: 0 });
    let on_disk: u64 = segments(folder.path()).iter().map(|file| file.metadata().unwrap().len()).sum();
    assert_eq!(log.bytes(), on_disk);
    assert!(segments(folder.path()).len() > 3, "several segments");
    for file in segments(folder.path()) {
        assert!(file.metadata().unwrap().len() <= SMALL.segment_bytes);
    }
}

#[test]
fn a_tail_cut_at_any_byte_costs_only_the_last_append() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open(folder.path());
    for k in 0..20 {
        log.append(&record(k)).unwrap();
    }
    let last = segments(folder.path()).pop().unwrap();
    let before = last.metadata().unwrap().len();
    log.append_batch(&[record(20), record(21), Vec::new(), record(23)]).unwrap();
    assert_eq!(segments(folder.path()).pop().unwrap(), last, "the batch fits the segment");
    let after = last.metadata().unwrap().len();
    let kept: Vec<_> = (0..20).map(record).collect();
    for length in before..after {
        let copy = copy(folder.path());
        let file = copy.path().join(last.file_name().unwrap());
        std::fs::OpenOptions::new().write(true).open(&file).unwrap().set_len(length).unwrap();
        let mut log = open(copy.path());
        assert_eq!(log.recovery(), &Recovery { records: 20, torn_bytes: length - before });
        assert_eq!(contents(&log), kept);
        assert_eq!(log.append(b"next").unwrap(), 20);
        drop(log);
        let log = open(copy.path());
        assert_eq!(log.recovery().torn_bytes, 0, "the tail was cut for good");
        assert_eq!(log.len(), 21);
    }
}

#[test]
fn a_tail_of_zeros_or_garbage_is_cut_and_counted() {
    for garbage in [vec![0u8; 300], (0..300u32).map(|i| (i * i % 251) as u8).collect()] {
        let folder = tempfile::tempdir().unwrap();
        let mut log = open(folder.path());
        log.append(b"kept").unwrap();
        let file = segments(folder.path()).pop().unwrap();
        let mut bytes = std::fs::read(&file).unwrap();
        bytes.extend_from_slice(&garbage);
        std::fs::write(&file, bytes).unwrap();
        let log = open(folder.path());
        assert_eq!(log.recovery(), &Recovery { records: 1, torn_bytes: 300 });
        assert_eq!(contents(&log), [b"kept".to_vec()]);
    }
}

#[test]
fn a_torn_record_that_holds_a_copy_of_the_log_is_still_torn() {
    let folder = tempfile::tempdir().unwrap();
    let limits = LogLimits { segment_bytes: 1 << 20, max_record_bytes: 1 << 16, max_batch_bytes: 1 << 16 };
    let mut log = AppendLog::open(folder.path(), limits).unwrap();
    log.append(b"one").unwrap();
    log.append(b"two").unwrap();
    let file = segments(folder.path()).pop().unwrap();
    let image = std::fs::read(&file).unwrap();
    log.append(&image).unwrap();
    let length = file.metadata().unwrap().len();
    std::fs::OpenOptions::new().write(true).open(&file).unwrap().set_len(length - 1).unwrap();
    let log = AppendLog::open(folder.path(), limits).unwrap();
    assert_eq!(log.len(), 2);
}

#[test]
fn any_flipped_byte_before_the_last_record_is_an_error_that_names_file_and_offset() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open(folder.path());
    let mut frames = Vec::new(); // (file, first byte, byte after the last)
    for k in 0..14 {
        let before = segments(folder.path()).pop().unwrap();
        let start = before.metadata().unwrap().len();
        log.append(&record(k + 20)).unwrap();
        let file = segments(folder.path()).pop().unwrap();
        let start = if file == before { start } else { 16 };
        frames.push((file.clone(), start, file.metadata().unwrap().len()));
    }
    drop(log);
    assert!(segments(folder.path()).len() >= 2);
    frames.pop();
    for (file, start, end) in frames {
        for at in start..end {
            let copy = copy(folder.path());
            let name = file.file_name().unwrap();
            let mut bytes = std::fs::read(&file).unwrap();
            bytes[at as usize] ^= 0x40;
            std::fs::write(copy.path().join(name), &bytes).unwrap();
            match AppendLog::open(copy.path(), SMALL) {
                Err(LogError::Damaged { path, offset, .. }) => {
                    assert_eq!((path.file_name().unwrap(), offset), (name, start), "byte {at}");
                }
                other => panic!("byte {at} of {name:?}: {other:?}"),
            }
            assert_eq!(std::fs::read(copy.path().join(name)).unwrap(), bytes, "nothing was changed");
        }
    }
}

#[test]
fn damage_after_the_start_is_met_when_the_record_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open(folder.path());
    log.append(b"first").unwrap();
    log.append(b"second").unwrap();
    let file = segments(folder.path()).pop().unwrap();
    let mut bytes = std::fs::read(&file).unwrap();
    let end = bytes.len();
    bytes[end - 2] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    let read: Vec<_> = log.iter().collect();
    assert_eq!(read.len(), 2, "the error ends the iteration");
    assert_eq!(read[0].as_ref().unwrap().bytes, b"first");
    assert!(matches!(read[1], Err(LogError::Damaged { .. })));
}

#[test]
fn a_segment_that_is_gone_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open(folder.path());
    for k in 0..60 {
        log.append(&record(k)).unwrap();
    }
    drop(log);
    std::fs::remove_file(&segments(folder.path())[1]).unwrap();
    let error = AppendLog::open(folder.path(), SMALL).unwrap_err();
    assert!(matches!(error, LogError::Missing { .. }), "{error}");
    assert!(error.to_string().contains("has no segment that begins with record"), "{error}");
}

#[test]
fn a_cut_in_an_earlier_segment_is_damage_and_not_a_torn_tail() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open(folder.path());
    for k in 0..60 {
        log.append(&record(k)).unwrap();
    }
    drop(log);
    let file = segments(folder.path()).remove(0);
    let length = file.metadata().unwrap().len();
    std::fs::OpenOptions::new().write(true).open(&file).unwrap().set_len(length - 3).unwrap();
    assert!(
        matches!(AppendLog::open(folder.path(), SMALL), Err(LogError::Damaged { path, .. }) if path == file)
    );
}

#[test]
fn what_is_over_the_limit_is_refused_and_leaves_the_log_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = open(folder.path());
    assert!(matches!(log.append(&[0; 257]), Err(LogError::TooLarge { bytes: 257, limit: 256, .. })));
    let batch = vec![[0u8; 250]; 5];
    assert!(matches!(log.append_batch(&batch), Err(LogError::TooLarge { limit: 1024, .. })));
    assert_eq!(log.append(&[7; 256]).unwrap(), 0);
    assert_eq!(contents(&log), [vec![7; 256]]);
}

#[test]
fn a_lower_limit_at_the_next_start_never_cuts_what_was_acknowledged() {
    let folder = tempfile::tempdir().unwrap();
    open(folder.path()).append(&[7; 256]).unwrap();
    let lower = LogLimits { max_record_bytes: 16, max_batch_bytes: 16, ..SMALL };
    assert!(matches!(AppendLog::open(folder.path(), lower), Err(LogError::Damaged { .. })));
    assert_eq!(open(folder.path()).len(), 1);
}

#[test]
fn a_log_whose_folder_cannot_be_made_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, b"").unwrap();
    let error = AppendLog::open(file.join("log"), SMALL).unwrap_err().to_string();
    assert!(error.contains("file"), "{error}");
}

const CHILD: &str = "COMA_STORE_TEST_APPENDS_TO";

/// The child of the test below: appends until it is killed, and says what was acknowledged.
fn append_until_killed(folder: &Path) -> ! {
    let mut log = open(folder);
    loop {
        let at = log.len() as usize;
        let range = match at % 4 {
            0 => log.append_batch(&[record(at), record(at + 1), record(at + 2)]).unwrap(),
            _ => log.append(&record(at)).map(|k| k..k + 1).unwrap(),
        };
        eprintln!("acknowledged {}", range.end);
    }
}

#[test]
fn every_acknowledged_record_survives_kill_9() {
    if let Some(folder) = std::env::var_os(CHILD) {
        append_until_killed(Path::new(&folder));
    }
    let folder = tempfile::tempdir().unwrap();
    let mut acknowledged = 0;
    for round in 0..6 {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "every_acknowledged_record_survives_kill_9", "--nocapture"])
            .env(CHILD, folder.path())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        for line in lines.by_ref().take(17 + 5 * round) {
            acknowledged = line.unwrap().trim_start_matches("acknowledged ").parse().unwrap();
        }
        child.kill().unwrap(); // SIGKILL
        child.wait().unwrap();
        // What it still said before it died counts too; a last line may be cut.
        for line in lines.map_while(Result::ok) {
            if let Ok(count) = line.trim_start_matches("acknowledged ").parse::<u64>() {
                acknowledged = acknowledged.max(count);
            }
        }
        let log = open(folder.path());
        assert!(
            log.len() >= acknowledged && acknowledged > 10 * (round as u64 + 1),
            "{acknowledged}, {log:?}"
        );
        let expected: Vec<_> = (0..log.len() as usize).map(record).collect();
        assert_eq!(contents(&log), expected);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]

    /// Whatever a segment file holds: an error or a log, no panic.
    #[test]
    fn foreign_segment_files_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), with_head in any::<bool>()) {
        let folder = tempfile::tempdir().unwrap();
        drop(open(folder.path()));
        let file = segments(folder.path()).pop().unwrap();
        let mut content = if with_head { std::fs::read(&file).unwrap() } else { Vec::new() };
        content.extend_from_slice(&bytes);
        std::fs::write(&file, content).unwrap();
        let opened = AppendLog::open(folder.path(), SMALL);
        prop_assert_eq!(opened.is_ok(), with_head);
    }
}
