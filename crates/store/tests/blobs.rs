//! The blob store: content, budget, damage.

use coma_store::{BlobError, BlobName, BlobSettings, Blobs};
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

fn settings(budget_bytes: u64) -> BlobSettings {
    BlobSettings { max_blob_bytes: 1000, budget_bytes }
}

fn file_of(folder: &tempfile::TempDir, name: &BlobName) -> PathBuf {
    let name = name.to_string();
    folder.path().join(&name[..2]).join(name)
}

#[test]
fn a_blob_comes_back_under_the_hash_of_its_bytes_also_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let mut blobs = Blobs::open(folder.path(), settings(10_000)).unwrap();
    let name = blobs.put(b"depth").unwrap();
    assert_eq!(name, BlobName::of(b"depth"));
    assert_eq!(name.to_string(), blake3::hash(b"depth").to_hex().as_str());
    assert_eq!(name.to_string().parse::<BlobName>().unwrap(), name);
    let mut blobs = Blobs::open(folder.path(), settings(10_000)).unwrap();
    assert!(blobs.contains(&name));
    assert_eq!((blobs.len(), blobs.total_bytes()), (1, 5));
    assert_eq!(blobs.get(&name).unwrap().as_deref(), Some(&b"depth"[..]));
    assert_eq!(blobs.get(&BlobName::of(b"other")).unwrap(), None);
}

#[test]
fn putting_the_same_bytes_twice_stores_them_once() {
    let folder = tempfile::tempdir().unwrap();
    let mut blobs = Blobs::open(folder.path(), settings(10_000)).unwrap();
    assert_eq!(blobs.put(b"same").unwrap(), blobs.put(b"same").unwrap());
    assert_eq!((blobs.len(), blobs.total_bytes()), (1, 4));
}

#[test]
fn a_name_is_64_lower_case_digits_and_nothing_else() {
    let name = BlobName::of(b"x").to_string();
    for wrong in [
        "",
        "ab",
        "../../etc/passwd",
        &name.to_uppercase(),
        &format!("{name}0"),
        &name.replacen(&name[..1], "é", 1),
    ] {
        let text = wrong.parse::<BlobName>().unwrap_err().text;
        assert_eq!(text, wrong.chars().take(80).collect::<String>());
    }
}

#[test]
fn a_blob_over_the_limit_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut blobs = Blobs::open(folder.path(), settings(10_000)).unwrap();
    assert!(matches!(blobs.put(&[0; 1001]), Err(BlobError::TooLarge { bytes: 1001, limit: 1000 })));
    assert!(blobs.is_empty());
}

#[test]
fn a_damaged_blob_is_an_error_once_and_can_then_be_put_again() {
    let folder = tempfile::tempdir().unwrap();
    let mut blobs = Blobs::open(folder.path(), settings(10_000)).unwrap();
    for damage in [&b"deptH"[..], b"dept", b"depth and more", b""] {
        let name = blobs.put(b"depth").unwrap();
        std::fs::write(file_of(&folder, &name), damage).unwrap();
        let error = blobs.get(&name).unwrap_err();
        assert!(
            matches!(&error, BlobError::Damaged { path, .. } if *path == file_of(&folder, &name)),
            "{error}"
        );
        assert!(!blobs.contains(&name) && blobs.total_bytes() == 0);
        assert_eq!(blobs.get(&name).unwrap(), None);
    }
    let name = blobs.put(b"depth").unwrap();
    std::fs::remove_file(file_of(&folder, &name)).unwrap();
    assert!(matches!(blobs.get(&name), Err(BlobError::Damaged { bytes: 0, .. })));
    let name = blobs.put(b"depth").unwrap();
    assert_eq!(blobs.get(&name).unwrap().as_deref(), Some(&b"depth"[..]));
}

#[test]
fn the_least_recently_used_goes_first_and_pinned_blobs_stay() {
    let folder = tempfile::tempdir().unwrap();
    let mut blobs = Blobs::open(folder.path(), settings(300)).unwrap();
    let [a, b, c] = [1u8, 2, 3].map(|k| blobs.put(&[k; 100]).unwrap());
    blobs.get(&a).unwrap();
    let d = blobs.put(&[4; 100]).unwrap();
    let here = |blobs: &Blobs| [a, b, c, d].map(|name| blobs.contains(&name));
    assert_eq!(here(&blobs), [true, false, true, true], "b was used least recently");
    blobs.pin(c);
    let e = blobs.put(&[5; 150]).unwrap();
    assert_eq!(here(&blobs), [false, false, true, false]);
    assert!(blobs.contains(&e));
    assert_eq!(blobs.total_bytes(), 250);
    assert!(!file_of(&folder, &a).exists(), "evicted from the disk too");
    blobs.pin(e);
    let f = blobs.put(&[6; 200]).unwrap();
    assert!(
        blobs.contains(&f) && blobs.contains(&c) && blobs.contains(&e),
        "nothing but the new one to remove"
    );
    blobs.unpin(&c);
    assert_eq!(blobs.evict().unwrap(), [c, f]);
    assert_eq!(blobs.total_bytes(), 150);
}

#[test]
fn the_order_of_use_survives_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let mut blobs = Blobs::open(folder.path(), settings(300)).unwrap();
    let [a, b, c] = [1u8, 2, 3].map(|k| blobs.put(&[k; 100]).unwrap());
    for (name, age_s) in [(a, 30), (b, 20), (c, 10)] {
        let file = std::fs::File::open(file_of(&folder, &name)).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(age_s)).unwrap();
    }
    blobs.get(&a).unwrap();
    let mut blobs = Blobs::open(folder.path(), settings(100)).unwrap();
    assert_eq!(blobs.evict().unwrap(), [b, c]);
    assert!(blobs.contains(&a));
}

#[test]
fn a_half_written_blob_of_a_crash_is_no_blob() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("blob.tmp"), b"half").unwrap();
    std::fs::create_dir(folder.path().join("ab")).unwrap();
    std::fs::write(folder.path().join("ab").join("notes.txt"), b"not ours").unwrap();
    let mut blobs = Blobs::open(folder.path(), settings(300)).unwrap();
    assert!(blobs.is_empty());
    let name = blobs.put(b"whole").unwrap();
    assert_eq!(blobs.get(&name).unwrap().as_deref(), Some(&b"whole"[..]));
}
