//! The identity: made once, kept, and nobody else's.

use coma_geometry::{AgentId, Epoch};
use coma_store::{Identity, IdentityError};
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

fn id(text: &str) -> Option<AgentId> {
    Some(AgentId::new(text).unwrap())
}

#[test]
fn an_agent_without_a_name_makes_one_and_keeps_it_with_its_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let first = Identity::open(folder.path().join("data/agent"), None).unwrap();
    let (name, epoch) = (first.agent_id().clone(), first.epoch());
    assert!(first.created());
    assert_eq!(name.as_str().len(), "agent-".len() + 8);
    assert!(name.as_str().starts_with("agent-"));
    assert!(epoch.0 > 1_600_000_000_000, "milliseconds since 1970: {epoch:?}");
    drop(first);
    let second = Identity::open(folder.path().join("data/agent"), None).unwrap();
    assert_eq!((second.agent_id(), second.epoch(), second.created()), (&name, epoch, false));
}

#[test]
fn two_agents_without_names_get_two_names() {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let [a, b] = folders.each_ref().map(|folder| Identity::open(folder.path(), None).unwrap());
    assert_ne!(a.agent_id(), b.agent_id());
}

#[test]
fn an_agent_that_lost_its_disk_has_a_later_epoch() {
    let (before, after) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let first = Identity::open(before.path(), id("alice")).unwrap();
    #[allow(clippy::disallowed_methods, reason = "an epoch is the time of its start, to the millisecond")]
    std::thread::sleep(std::time::Duration::from_millis(2));
    let second = Identity::open(after.path(), id("alice")).unwrap();
    assert!(second.epoch() > first.epoch());
}

#[test]
fn a_folder_of_another_agent_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    drop(Identity::open_with_epoch(folder.path(), id("alice"), Epoch(7)).unwrap());
    let error = Identity::open(folder.path(), id("bob")).unwrap_err();
    assert!(matches!(error, IdentityError::OtherAgent { .. }));
    assert!(error.to_string().contains("belongs to agent alice, the settings say bob"), "{error}");
    let again = Identity::open(folder.path(), id("alice")).unwrap();
    assert_eq!((again.agent_id().as_str(), again.epoch()), ("alice", Epoch(7)));
}

#[test]
fn a_damaged_identity_file_is_named_and_not_replaced() {
    let wrong = [
        &b""[..],
        b"agent_id = 'alice'",
        b"agent_id = 'No Such Name!'\nepoch = 1",
        b"agent_id = 'alice'\nepoch = -1",
        b"agent_id = 'alice'\nepoch = 1\nextra = 2",
        b"\xff\xfe",
    ];
    for text in wrong {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("agent.toml");
        std::fs::write(&file, text).unwrap();
        let error = Identity::open(folder.path(), None).unwrap_err();
        assert!(matches!(&error, IdentityError::Damaged { path, .. } if *path == file), "{error}");
        assert_eq!(std::fs::read(&file).unwrap(), text);
    }
}

#[test]
fn an_epoch_is_refused_or_read_back_as_it_was() {
    for epoch in [0, 1, i64::MAX as u64, i64::MAX as u64 + 1, u64::MAX].map(Epoch) {
        let folder = tempfile::tempdir().unwrap();
        match Identity::open_with_epoch(folder.path(), id("alice"), epoch) {
            Ok(first) => {
                drop(first);
                assert_eq!(Identity::open(folder.path(), None).unwrap().epoch(), epoch);
            }
            Err(_) => {
                assert!(epoch.0 > i64::MAX as u64, "{epoch:?}");
                assert!(!folder.path().join("agent.toml").exists());
            }
        }
    }
}

const CHILD: &str = "COMA_STORE_TEST_HOLDS";

#[test]
fn a_folder_has_one_process_until_that_ends_however_it_ends() {
    if let Some(folder) = std::env::var_os(CHILD) {
        let _held = Identity::open(folder, None).unwrap();
        eprintln!("held");
        loop {
            std::thread::park();
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "a_folder_has_one_process_until_that_ends_however_it_ends", "--nocapture"])
        .env(CHILD, folder.path())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(child.stderr.as_mut().unwrap()).read_line(&mut line).unwrap();
    assert_eq!(line.trim(), "held");
    match Identity::open(folder.path(), None) {
        Err(IdentityError::InUse { process, .. }) => assert_eq!(process, child.id().to_string()),
        other => panic!("{other:?}"),
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!Identity::open(folder.path(), None).unwrap().created());
}
