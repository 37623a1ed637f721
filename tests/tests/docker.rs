//! The images and the compose file, where a Docker daemon answers or can be started.

use std::path::Path;
use std::process::Command;

/// Ends of `docker/test.sh`: 0 passed, 77 no daemon.
#[test]
#[ignore = "needs a Docker daemon; builds images"]
fn docker_agents_of_one_configuration_come_and_go_and_the_gateway_follows() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests lie in the repository");
    let status = Command::new("bash")
        .arg(root.join("docker/test.sh"))
        .current_dir(root)
        .status()
        .expect("bash starts");
    match status.code() {
        Some(0) => {}
        Some(77) => panic!("no Docker daemon answers here, and none can be started: this test cannot run"),
        code => panic!("docker/test.sh ended with {code:?}"),
    }
}
