//! `coma-place-recognition`: encoders and the index of places, for one agent or several.

use clap::Parser;
use coma_place_recognition::{PlaceRecognitionConfig, Server};
use std::net::SocketAddr;
use std::path::PathBuf;

/// Describes pictures and finds anchors that may show one place. Agents call it over gRPC.
///
/// The builtin descriptor needs nothing; other encoders are models that ONNX Runtime runs (setting `models`: their
/// manifests). Settings come from --config (TOML) and from the environment:
/// COMA_PLACE_RECOGNITION__SERVER__TOKEN=... sets `server.token`,
/// COMA_PLACE_RECOGNITION__MODELS=dinov2.toml sets `models`.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Settings file (TOML). Without it, place-recognition.toml in the data folder is read if it is there.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address and port to serve on; overrides `server.listen`.
    #[arg(long)]
    listen: Option<SocketAddr>,
    /// Folder of the models, and of the settings file; overrides `data`. Nothing is written there.
    #[arg(long)]
    data: Option<PathBuf>,
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    let in_data = arguments.data.as_ref().map(|folder| folder.join("place-recognition.toml"));
    let file = arguments.config.or(in_data.filter(|file| file.is_file()));
    let mut config: PlaceRecognitionConfig = coma_runtime::load(file.as_deref(), "COMA_PLACE_RECOGNITION")?;
    coma_runtime::logging::init(&config.log)?;
    if let Some(listen) = arguments.listen {
        config.server.listen = listen;
    }
    if let Some(data) = arguments.data {
        config.data = data;
    }
    let handle = Server::start(config).await?;
    println!("place-recognition serves on {}", handle.url);
    coma_runtime::shutdown::requested().await;
    handle.shutdown().await;
    Ok(())
}
