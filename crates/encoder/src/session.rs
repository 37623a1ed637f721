//! One loaded model, with errors that name its file.

use crate::EncoderError;
use crate::runtime::{RuntimeSettings, environment};
use ort::session::Session;
use ort::value::{Outlet, Tensor, TensorElementType, ValueType};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// A model and the name of the output that is read.
pub(crate) struct Model {
    path: PathBuf,
    output: String,
    session: Mutex<Session>,
}

/// Names and shapes of a model's inputs or outputs.
pub(crate) struct Port {
    pub(crate) name: String,
    /// -1 for a side that is free; `None` if it is no tensor of 32-bit floats.
    pub(crate) shape: Option<Vec<i64>>,
}

fn ports(outlets: &[Outlet]) -> Vec<Port> {
    let port = |outlet: &Outlet| Port {
        name: outlet.name().to_owned(),
        shape: match outlet.dtype() {
            ValueType::Tensor { ty: TensorElementType::Float32, shape, .. } => Some(shape.to_vec()),
            _ => None,
        },
    };
    outlets.iter().map(port).collect()
}

impl Model {
    /// Loads a model; `choose` says from its inputs and outputs which output is read.
    pub(crate) fn load(
        path: &Path,
        settings: &RuntimeSettings,
        choose: impl FnOnce(&[Port], &[Port]) -> Result<String, EncoderError>,
    ) -> Result<Model, EncoderError> {
        if let Err(source) = std::fs::File::open(path) {
            return Err(EncoderError::File { path: path.to_owned(), source });
        }
        let environment = environment(settings)?;
        let failed = |reason: String| EncoderError::Model { path: path.to_owned(), reason };
        let session = Session::builder(&environment)
            .map_err(|error| failed(error.to_string()))?
            .with_intra_threads(settings.threads.max(1))
            .map_err(|error| failed(error.to_string()))?
            .commit_from_file(path)
            .map_err(|error| failed(error.to_string()))?;
        let output = choose(&ports(session.inputs()), &ports(session.outputs()))?;
        Ok(Model { path: path.to_owned(), output, session: Mutex::new(session) })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Runs the model on images `[1, 3, height, width]`, one for each of its inputs in `names`, and hands shape and
    /// values of the output to `read`.
    pub(crate) fn run<T, const N: usize>(
        &self,
        names: [&str; N],
        images: [Vec<f32>; N],
        [height, width]: [usize; 2],
        read: impl FnOnce(&[i64], &[f32]) -> Result<T, EncoderError>,
    ) -> Result<T, EncoderError> {
        let failed =
            |error: ort::Error| EncoderError::Run { path: self.path.clone(), reason: error.to_string() };
        let mut inputs = Vec::with_capacity(N);
        for (name, image) in names.into_iter().zip(images) {
            let tensor = Tensor::from_array(([1, 3, height, width], image)).map_err(failed)?;
            inputs.push((name, tensor));
        }
        let mut session = self.session.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let outputs = session.run(inputs).map_err(failed)?;
        let value =
            outputs.get(&self.output).expect("the output's name was checked when the model was loaded");
        let (shape, data) = value.try_extract_tensor::<f32>().map_err(failed)?;
        read(shape, data)
    }
}

/// A shape in words; free sides as `?`.
pub(crate) fn shape_words(shape: &Option<Vec<i64>>) -> String {
    let Some(shape) = shape else { return "no tensor of 32-bit floats".into() };
    let sides: Vec<_> = shape.iter().map(|s| if *s < 0 { "?".into() } else { s.to_string() }).collect();
    format!("[{}]", sides.join(", "))
}

/// Whether an image `[1, 3, height, width]` fits a port; `None` for a side that is not yet known.
pub(crate) fn takes_image(shape: &Option<Vec<i64>>, height: Option<usize>, width: Option<usize>) -> bool {
    let fits = |side: i64, wanted: Option<usize>| side < 0 || wanted.is_none_or(|w| side == w as i64);
    match shape.as_deref() {
        Some([n, c, h, w]) => fits(*n, Some(1)) && fits(*c, Some(3)) && fits(*h, height) && fits(*w, width),
        _ => false,
    }
}

/// The port of a name, or the error that lists those there are.
pub(crate) fn port_named<'a>(
    ports: &'a [Port],
    kind: &'static str,
    name: &str,
    path: &Path,
) -> Result<&'a Port, EncoderError> {
    ports.iter().find(|port| port.name == name).ok_or_else(|| {
        let found: Vec<_> = ports.iter().map(|port| format!("{:?}", port.name)).collect();
        let found = found.join(", ");
        EncoderError::NoSuchName { path: path.to_owned(), kind, name: name.to_owned(), found }
    })
}
