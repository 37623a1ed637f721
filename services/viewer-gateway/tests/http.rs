//! What callers see of a gateway, over HTTP, without any agent.

use coma_runtime::Secret;
use coma_viewer_gateway::{GatewayConfig, Handle, Server};
use reqwest::{Client, Response, StatusCode};
use serde_json::{Value, json};
use std::time::{Duration, Instant};

fn config() -> GatewayConfig {
    GatewayConfig {
        listen: ([127, 0, 0, 1], 0).into(),
        status_every_s: 0.1,
        status_timeout_s: 0.3,
        ..Default::default()
    }
}

async fn start(config: GatewayConfig) -> Handle {
    Server::start(config).await.unwrap()
}

async fn get(gateway: &Handle, path: &str) -> Response {
    Client::new().get(format!("{}{path}", gateway.url)).send().await.unwrap()
}

async fn json_of(gateway: &Handle, path: &str) -> (StatusCode, Value) {
    let response = get(gateway, path).await;
    let status = response.status();
    (status, response.json().await.unwrap())
}

/// Asks until the answer holds; the message is the last answer.
async fn wait_for(gateway: &Handle, path: &str, holds: impl Fn(&Value) -> bool) -> Value {
    let begin = Instant::now();
    loop {
        let (_, answer) = json_of(gateway, path).await;
        if holds(&answer) {
            return answer;
        }
        assert!(begin.elapsed() < Duration::from_secs(20), "{path}: {answer}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test]
async fn without_agents_everything_answers_and_says_so() {
    let gateway = start(config()).await;
    assert_eq!(get(&gateway, "/healthz").await.text().await.unwrap(), "ok\n");
    wait_for(&gateway, "/readyz", |r| r == &json!({"ready": true, "agents": 0, "reachable": 0})).await;
    assert_eq!(json_of(&gateway, "/api/v1/agents").await, (StatusCode::OK, json!({"agents": []})));
    let empty = json!({"trajectories": [], "unreachable": []});
    assert_eq!(json_of(&gateway, "/api/v1/trajectories").await, (StatusCode::OK, empty));
    assert_eq!(json_of(&gateway, "/api/v1/submaps").await.1, json!({"submaps": [], "unreachable": []}));
    assert_eq!(json_of(&gateway, "/api/v1/maps").await.1, json!({"maps": [], "unreachable": []}));
    assert_eq!(json_of(&gateway, "/api/v1/graph").await.1["loops"], json!([]));
    let (status, problem) = json_of(&gateway, "/api/v1/map.ply").await;
    assert_eq!((status, &problem["error"]["field"]), (StatusCode::NOT_FOUND, &json!("map")));
    assert!(problem["error"]["message"].as_str().unwrap().contains("no agent has mapped anything yet"));
    gateway.shutdown().await;
}

#[tokio::test]
async fn a_bad_request_names_its_field() {
    let gateway = start(config()).await;
    for (path, status, field) in [
        ("/api/v1/trajectories?first_sequence=x", 400, "first_sequence"),
        ("/api/v1/trajectories?nonsense=1", 400, "nonsense"),
        ("/api/v1/trajectories?agent=Not%20a%20name", 400, "agent"),
        ("/api/v1/trajectories?agent=nobody", 404, "agent"),
        ("/api/v1/agents/nobody/trajectory.tum", 404, "agent"),
        ("/api/v1/agents/%00/trajectory.tum", 400, "agent"),
        ("/api/v1/submaps?open=maybe", 400, "open"),
        ("/api/v1/submaps/a/one/s0/surfels", 400, "epoch"),
        ("/api/v1/submaps/a/1/0/surfels", 400, "number"),
        ("/api/v1/submaps/a/1/s0/surfels", 404, "agent"),
        ("/api/v1/submaps/a/1/s0/surfels?format=stl", 400, "format"),
        ("/api/v1/submaps/a/1/s0/surfels?revision=-1", 400, "revision"),
        ("/api/v1/map.ply?map=somewhere", 400, "map"),
        ("/api/v1/map.ply?map=a/1", 404, "map"),
        ("/api/v1/maps/relation?old=a/1", 400, "new"),
        ("/api/v1/maps/relation?old=a/1&new=b", 400, "new"),
        ("/api/v1/render", 400, "tx_m"),
        ("/api/v1/render?tx_m=0&ty_m=0&tz_m=0&qx=0&qy=0&qz=0&qw=1&width=0", 400, "width"),
        ("/api/v1/render?tx_m=0&ty_m=0&tz_m=0&qx=0&qy=0&qz=0&qw=1&fx=nan", 400, "fx"),
        ("/api/v1/render?tx_m=inf&ty_m=0&tz_m=0&qx=0&qy=0&qz=0&qw=1", 400, "tx_m"),
        ("/api/v1/render?tx_m=0&ty_m=0&tz_m=0&qx=0&qy=0&qz=0&qw=1&output=heat", 400, "output"),
        ("/api/v1/render?tx_m=0&ty_m=0&tz_m=0&qx=0&qy=0&qz=0&qw=1&width=8000&height=8000", 413, "width"),
        ("/api/v1/render?tx_m=0&ty_m=0&tz_m=0&qx=0&qy=0&qz=0&qw=1", 404, "map"),
        ("/api/v1/nothing", 404, "path"),
        ("/../../etc/passwd", 404, "path"),
    ] {
        let (found, problem) = json_of(&gateway, path).await;
        assert_eq!(
            (found.as_u16(), &problem["error"]["field"]),
            (status, &json!(field)),
            "{path}: {problem}"
        );
        assert!(problem["error"]["message"].is_string(), "{path}: {problem}");
    }
}

#[tokio::test]
async fn a_bad_body_names_its_field() {
    let gateway = start(config()).await;
    let pose = json!({"tx_m": 0, "ty_m": 0, "tz_m": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1});
    let camera = json!({"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5});
    let good = json!({"map_from_camera": pose, "camera": camera});
    let with = |path: &str, value: Value| {
        let mut body = good.clone();
        *body.pointer_mut(path).unwrap() = value;
        body.to_string()
    };
    let mut unknown = good.clone();
    unknown["camera"]["zoom"] = json!(2);
    let mut missing = good.clone();
    missing["camera"].as_object_mut().unwrap().remove("cy");
    for (body, status, field) in [
        (with("/camera/fx", json!(0)), 400, "camera.fx"),
        (with("/camera/fx", json!("wide")), 400, "camera.fx"),
        (with("/camera/width", json!(-3)), 400, "camera.width"),
        (with("/camera/width", json!(1u64 << 40)), 400, "camera.width"),
        (with("/map_from_camera/tz_m", json!(1e300)), 400, "map_from_camera.tz_m"),
        (with("/map_from_camera/qw", json!(3)), 400, "map_from_camera"),
        (unknown.to_string(), 400, "camera.zoom"),
        (missing.to_string(), 400, "camera.cy"),
        (good.to_string() + "x", 400, "body"),
        ("{".into(), 400, "body"),
        (String::new(), 400, "body"),
        (format!("{{\"map\": {}", "[".repeat(60_000)), 400, "map"),
        (" ".repeat(1 << 20), 413, "body"),
        (good.to_string(), 404, "map"),
    ] {
        let url = format!("{}/api/v1/render", gateway.url);
        let response = Client::new().post(url).body(body.clone()).send().await.unwrap();
        let found = response.status().as_u16();
        let problem: Value = response.json().await.unwrap();
        let shown: String = body.chars().take(300).collect();
        assert_eq!((found, &problem["error"]["field"]), (status, &json!(field)), "{shown}: {problem}");
    }
    let response = Client::new().delete(format!("{}/api/v1/render", gateway.url)).send().await.unwrap();
    assert_eq!(response.status(), StatusCode::METHOD_NOT_ALLOWED);
    assert!(response.json::<Value>().await.unwrap()["error"]["message"].as_str().unwrap().contains("DELETE"));
}

#[tokio::test]
async fn a_token_is_asked_for_everywhere_but_for_health_and_the_page() {
    let gateway = start(GatewayConfig { token: Some(Secret::new("right")), ..config() }).await;
    for path in ["/api/v1/agents", "/api/v1/events", "/api/v1/openapi.json", "/metrics", "/api/v1/map.ply"] {
        let with = async |token: Option<&str>| {
            let mut request = Client::new().get(format!("{}{path}", gateway.url));
            if let Some(token) = token {
                request = request.header("authorization", token);
            }
            request.send().await.unwrap().status()
        };
        for wrong in [None, Some("Bearer wrong"), Some("right"), Some("Basic right"), Some("Bearer")] {
            assert_eq!(with(wrong).await, StatusCode::UNAUTHORIZED, "{path} {wrong:?}");
        }
        assert_ne!(with(Some("Bearer right")).await, StatusCode::UNAUTHORIZED, "{path}");
    }
    let (status, problem) = json_of(&gateway, "/api/v1/agents").await;
    assert_eq!((status, &problem["error"]["field"]), (StatusCode::UNAUTHORIZED, &json!("authorization")));
    for open in ["/healthz", "/readyz", "/"] {
        assert_ne!(get(&gateway, open).await.status(), StatusCode::UNAUTHORIZED, "{open}");
    }
}

#[tokio::test]
async fn a_gateway_beyond_loopback_needs_a_token_or_a_word() {
    let everywhere = GatewayConfig { listen: ([0, 0, 0, 0], 0).into(), ..config() };
    let error = Server::start(everywhere.clone()).await.err().unwrap().to_string();
    assert!(error.contains("token") && error.contains("insecure"), "{error}");
    let gateway = start(GatewayConfig { insecure: true, ..everywhere }).await;
    assert_eq!(get(&gateway, "/healthz").await.status(), StatusCode::OK);
}

#[tokio::test]
async fn agents_that_do_not_answer_are_shown_as_unreachable_and_nothing_hangs() {
    // One port that refuses, and one that takes the connection and never says a word.
    let silent = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let refusing = {
        let taken = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        taken.local_addr().unwrap()
    };
    let silent_url = format!("http://{}", silent.local_addr().unwrap());
    let agents = vec![format!("http://{refusing}"), silent_url.clone()];
    let gateway = start(GatewayConfig { agents, ..config() }).await;
    wait_for(&gateway, "/readyz", |r| r == &json!({"ready": true, "agents": 2, "reachable": 0})).await;
    let (_, answer) = json_of(&gateway, "/api/v1/agents").await;
    for agent in answer["agents"].as_array().unwrap() {
        assert_eq!((&agent["id"], &agent["reachable"]), (&Value::Null, &json!(false)));
        assert!(!agent["error"].as_str().unwrap().is_empty(), "{agent}");
    }
    let begin = Instant::now();
    for path in ["/api/v1/trajectories", "/api/v1/submaps", "/api/v1/graph", "/api/v1/maps"] {
        let (status, answer) = json_of(&gateway, path).await;
        assert_eq!(status, StatusCode::OK, "{path}");
        let endpoints: Vec<&str> = answer["unreachable"]
            .as_array()
            .unwrap()
            .iter()
            .map(|u| u["endpoint"].as_str().unwrap())
            .collect();
        assert!(endpoints.contains(&silent_url.as_str()) && endpoints.len() == 2, "{path}: {answer}");
    }
    let (status, problem) = json_of(&gateway, "/api/v1/map.ply").await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    assert!(problem["error"]["message"].as_str().unwrap().contains(&silent_url), "{problem}");
    assert!(begin.elapsed() < Duration::from_secs(5));
    let metrics = get(&gateway, "/metrics").await.text().await.unwrap();
    assert!(metrics.contains(&format!("coma_agent_reachable{{agent=\"{silent_url}\"}} 0")), "{metrics}");
    assert!(metrics.contains("coma_gateway_requests_total{"), "{metrics}");
}

#[tokio::test]
async fn settings_that_name_no_agent_are_refused_by_name() {
    for (config, named) in [
        (GatewayConfig { agents: vec!["robot-1:7001".into()], ..config() }, "agents[0]"),
        (GatewayConfig { agents_dns: Some("agent".into()), ..config() }, "agents_dns"),
        (GatewayConfig { agents_dns: Some("ftp://agent:1".into()), ..config() }, "agents_dns"),
    ] {
        let error = format!("{:#}", Server::start(config).await.err().unwrap());
        assert!(error.contains(named), "{error}");
    }
}

#[tokio::test]
async fn agents_are_found_by_dns() {
    let silent = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let agents_dns = Some(format!("localhost:{}", silent.local_addr().unwrap().port()));
    let gateway = start(GatewayConfig { agents_dns, ..config() }).await;
    let endpoint = format!("http://{}", silent.local_addr().unwrap());
    let found = |answer: &Value| {
        answer["agents"].as_array().unwrap().iter().any(|a| a["endpoint"] == json!(endpoint))
    };
    wait_for(&gateway, "/api/v1/agents", found).await;
}

#[tokio::test]
async fn openapi_describes_what_is_served() {
    let gateway = start(config()).await;
    let (status, description) = json_of(&gateway, "/api/v1/openapi.json").await;
    assert_eq!(status, StatusCode::OK);
    assert!(description["openapi"].as_str().unwrap().starts_with("3.1"));
    let paths = description["paths"].as_object().unwrap();
    for path in ["/api/v1/agents", "/api/v1/map.ply", "/api/v1/render", "/api/v1/events", "/metrics"] {
        assert!(paths.contains_key(path), "{path}");
    }
    assert!(paths["/api/v1/render"].get("post").is_some() && paths["/api/v1/render"].get("get").is_some());
    for path in paths.keys() {
        // What is described is there: a name that is not known is not a path that is not served.
        let asked = path.replace("{agent}", "nobody").replace("{epoch}", "1").replace("{number}", "s0");
        let response = get(&gateway, &asked).await;
        if response.status() == StatusCode::NOT_FOUND {
            let problem: Value = response.json().await.unwrap();
            assert_ne!(problem["error"]["field"], json!("path"), "{path}");
        }
    }
    // Every reference leads somewhere.
    fn references<'a>(value: &'a Value, out: &mut Vec<&'a str>) {
        match value {
            Value::Object(map) => map.iter().for_each(|(key, value)| match (key.as_str(), value) {
                ("$ref", Value::String(to)) => out.push(to),
                _ => references(value, out),
            }),
            Value::Array(items) => items.iter().for_each(|value| references(value, out)),
            _ => {}
        }
    }
    let mut found = Vec::new();
    references(&description, &mut found);
    assert!(found.len() > 10);
    for to in found {
        assert!(description.pointer(to.trim_start_matches('#')).is_some(), "{to}");
    }
}

#[tokio::test]
async fn the_page_and_its_files_come_from_the_program() {
    let gateway = start(config()).await;
    let page = get(&gateway, "/").await;
    assert_eq!(page.status(), StatusCode::OK);
    assert!(page.headers()["content-type"].to_str().unwrap().starts_with("text/html"));
    assert!(page.headers()["content-security-policy"].to_str().unwrap().contains("default-src 'self'"));
    let html = page.text().await.unwrap();
    assert!(!html.contains("http://") && !html.contains("https://"), "nothing is loaded from elsewhere");
    for script in html.split("src=\"").skip(1).map(|rest| rest.split('"').next().unwrap()) {
        let response = get(&gateway, &format!("/{}", script.trim_start_matches(['.', '/']))).await;
        assert_eq!(response.status(), StatusCode::OK, "{script}");
    }
}

/// `npm run check` in `web/viewer` says the same, and bundles again where the packages are installed.
#[test]
fn the_built_page_is_made_of_its_sources() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../web/viewer");
    let names = std::fs::read_dir(folder.join("src")).unwrap();
    let mut names: Vec<String> =
        names.map(|file| format!("src/{}", file.unwrap().file_name().into_string().unwrap())).collect();
    names.sort();
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    let mut update = |bytes: &[u8]| {
        // FNV-1a
        bytes.iter().for_each(|byte| hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3));
    };
    for name in ["build.js".to_owned(), "package-lock.json".to_owned()].iter().chain(&names) {
        let bytes = std::fs::read(folder.join(name)).unwrap();
        update(format!("{name} {}\n", bytes.len()).as_bytes());
        update(&bytes);
    }
    let built = std::fs::read_to_string(folder.join("dist/sources.txt")).unwrap();
    let expected = format!("{hash:016x}");
    assert_eq!(built.trim(), expected, "run `npm ci && npm run build` in web/viewer and commit dist");
    let size: u64 = std::fs::read_dir(folder.join("dist"))
        .unwrap()
        .map(|file| file.unwrap().metadata().unwrap().len())
        .sum();
    assert!(size < 1_500_000, "{size} bytes");
}

#[tokio::test]
async fn events_begin_with_again_and_listeners_are_counted() {
    let gateway = start(GatewayConfig { max_listeners: 1, ..config() }).await;
    let mut listening = get(&gateway, "/api/v1/events").await;
    assert!(listening.headers()["content-type"].to_str().unwrap().starts_with("text/event-stream"));
    let first = String::from_utf8(listening.chunk().await.unwrap().unwrap().to_vec()).unwrap();
    assert_eq!(first, "event: again\ndata: {\"type\":\"again\"}\n\n");
    assert_eq!(get(&gateway, "/api/v1/events").await.status(), StatusCode::SERVICE_UNAVAILABLE);
    drop(listening);
    let begin = Instant::now();
    while get(&gateway, "/api/v1/events").await.status() != StatusCode::OK {
        assert!(begin.elapsed() < Duration::from_secs(10), "a place is free again when a listener has gone");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test]
async fn a_gateway_ends_while_somebody_listens() {
    let gateway = start(config()).await;
    let mut listening = get(&gateway, "/api/v1/events").await;
    let begin = Instant::now();
    gateway.shutdown().await;
    while listening.chunk().await.unwrap_or(None).is_some() {}
    assert!(begin.elapsed() < Duration::from_secs(4), "it did not wait for the listener");
}
