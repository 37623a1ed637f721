//! The page in a browser: `web/viewer/test/page.mjs` opens it in Chromium and says what it saw.

use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, BufReader};
use tokio::process::{Child, Command};

/// An open page.
pub struct Page {
    browser: Child,
    picture: PathBuf,
}

impl Page {
    /// Opens it; none, with a word about it, where Chromium or the page's packages are not installed.
    pub async fn open(url: &str, frames: usize) -> Option<Page> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../web/viewer");
        let installed = |program: &str| {
            std::env::var_os("PATH")
                .is_some_and(|path| std::env::split_paths(&path).any(|dir| dir.join(program).exists()))
        };
        let chromium = installed("chromium") || std::env::var_os("CHROMIUM").is_some();
        if !installed("node") || !chromium || !folder.join("node_modules/puppeteer-core").exists() {
            eprintln!("SKIPPED: the page; it needs node, chromium, and `npm ci` in web/viewer");
            return None;
        }
        let picture = Path::new(env!("CARGO_TARGET_TMPDIR")).join("page.png");
        let _ = std::fs::remove_file(&picture);
        let mut browser = Command::new("node")
            .arg("test/page.mjs")
            .args([url, picture.to_str().expect("a path that is text"), &frames.to_string()])
            .current_dir(folder)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .unwrap();
        // It says so when it is open; frames are streamed after that, so that it sees the map grow.
        let mut words = BufReader::new(browser.stderr.take().unwrap()).lines();
        let mut said = Vec::new();
        loop {
            match words.next_line().await.unwrap() {
                Some(line) if line == "the page is open" => break,
                Some(line) => said.push(line),
                None => panic!("the page did not open: {}", said.join("\n")),
            }
        }
        tokio::spawn(async move {
            while let Ok(Some(line)) = words.next_line().await {
                eprintln!("page: {line}");
            }
        });
        Some(Page { browser, picture })
    }

    /// Waits until it has seen all, and checks what.
    pub async fn shows_both_agents(mut self) {
        let mut text = String::new();
        self.browser.stdout.take().unwrap().read_to_string(&mut text).await.unwrap();
        assert!(self.browser.wait().await.unwrap().success(), "the page did not come to show everything");
        let seen: Value = serde_json::from_str(&text).unwrap();
        eprintln!("the page: {}, {seen}", self.picture.display());
        assert_eq!(seen["errors"], json!([]));
        assert_eq!(seen["hint"], json!("The agents wait for frames"), "while there is nothing to see");
        let count = |path: &str| {
            seen.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("{path}: {seen}"))
        };
        assert_eq!(count("/counts/agents"), 2.0);
        assert_eq!(count("/counts/maps"), 1.0);
        assert!(count("/counts/surfels") > 1000.0 && count("/counts/drawnSurfels") >= 0.0);
        for agent in ["agent-00", "agent-01"] {
            assert_eq!(count(&format!("/counts/trajectories/{agent}")), 65.0);
            // Lines of the agent's own colour are there when they are switched on, and only then.
            for kind in ["trajectories", "cameras"] {
                assert!(count(&format!("/{kind}/agents/{agent}")) > 20.0, "{kind} of {agent}: {seen}");
            }
            assert_eq!(count(&format!("/nothing/agents/{agent}")), 0.0);
        }
        assert!(count("/surfels/drawn") > 20_000.0, "surfels cover a good part of the picture: {seen}");
        assert!(count("/loops/drawn") > 20.0, "{seen}");
        // The axes at the map's origin are always drawn.
        assert!(count("/nothing/drawn") < 2000.0, "{seen}");

        assert!((count("/correction/moved_m") - 1.0).abs() < 1e-6, "a correction moves its submap: {seen}");
        assert!(count("/correction/back_m").abs() < 1e-6, "what the agents say holds: {seen}");
        assert_eq!(seen["correction"]["downloaded"], json!(false), "no surfels came again: {seen}");
        for (what, most) in
            [("center", 1e-5), ("color", 1e-3), ("opacity", 3e-3), ("scale", 1e-3), ("rotation", 1e-3)]
        {
            assert!(count(&format!("/decoded/{what}")) < most, "{what} is read as it was written: {seen}");
        }
    }
}
