//! The gRPC side: requests are checked, work goes to threads of its own, answers come back.

use crate::encoders::Encoders;
use crate::indices::{Anchor, Full, Indices};
use crate::picture::{Decoded, Picture};
use coma_geometry::SubmapId;
use coma_place::Descriptor;
use coma_wire::v1::place_recognition_server::PlaceRecognition;
use coma_wire::{At, FieldError, Wire, limits, v1};
use std::collections::BTreeSet;
use std::sync::{Arc, PoisonError};
use std::time::Instant;
use tokio::sync::Semaphore;
use tonic::{Request, Response, Status};

/// Anchors in one Insert.
pub const MAX_ANCHORS_PER_CALL: usize = 1024;
/// Candidates of one Query.
pub const MAX_CANDIDATES: u32 = 1000;

/// Answers the calls of `coma.v1.PlaceRecognition`.
#[derive(Clone)]
pub struct PlaceService {
    /// Who describes pictures.
    pub encoders: Arc<Encoders>,
    /// What is known of places.
    pub indices: Arc<Indices>,
    /// One permit for each piece of work that may run at once.
    pub work: Arc<Semaphore>,
    /// Largest picture.
    pub max_pixels: usize,
}

impl PlaceService {
    /// Runs work on a thread of its own, once there is room. Work whose caller has gone is still finished,
    /// and holds its place until then.
    async fn work<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T, Status> + Send + 'static,
    ) -> Result<T, Status> {
        let permit = self.work.clone().acquire_owned().await;
        let permit = permit.map_err(|_| Status::unavailable("the service is ending"))?;
        let task = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            work()
        });
        task.await.map_err(|e| Status::internal(format!("the work on this call ended badly: {e}")))?
    }
}

/// A caller's index: named, and not too long.
fn index_name(name: String) -> Result<String, FieldError> {
    let at = At::Root("index");
    if name.is_empty() {
        return Err(at.refuse("is empty: name the index, for example by the agent's id"));
    }
    at.text(name, limits::NAME)
}

fn anchor(message: v1::Anchor, at: &At<'_>) -> Result<Anchor, FieldError> {
    let submap: SubmapId = at.field("submap_id").required(message.submap_id)?;
    let at = at.field("descriptors");
    if message.descriptors.is_empty() {
        return Err(at.refuse("is empty"));
    }
    let descriptors: Vec<Descriptor> = at.repeated(message.descriptors, limits::DESCRIPTORS)?;
    let mut spaces = BTreeSet::new();
    for (i, descriptor) in descriptors.iter().enumerate() {
        if !spaces.insert(descriptor.space()) {
            let message =
                format!("{} was named before: an anchor has one descriptor per space", descriptor.space());
            return Err(at.index(i).field("space").refuse(message));
        }
    }
    Ok(Anchor { submap, frame: message.anchor_frame, descriptors })
}

#[tonic::async_trait]
impl PlaceRecognition for PlaceService {
    async fn get_encoders(
        &self,
        _request: Request<v1::GetEncodersRequest>,
    ) -> Result<Response<v1::GetEncodersResponse>, Status> {
        let info = |(name, encoder): (&str, &dyn coma_place::Encoder)| {
            let thresholds = encoder.thresholds();
            v1::EncoderInfo {
                space: encoder.space().to_string(),
                name: name.to_owned(),
                dimension: encoder.dimension() as u32,
                theta_sim: thresholds.theta_sim,
                theta_multi: thresholds.theta_multi,
            }
        };
        let encoders = self.encoders.all().map(info).collect();
        Ok(Response::new(v1::GetEncodersResponse { encoders, warnings: self.encoders.warnings() }))
    }

    async fn describe(
        &self,
        request: Request<v1::DescribeRequest>,
    ) -> Result<Response<v1::DescribeResponse>, Status> {
        let picture = Picture::from_wire(request.into_inner(), self.max_pixels)?;
        let encoders = self.encoders.clone();
        let descriptors = self
            .work(move || {
                let begin = Instant::now();
                let Decoded { color, depth_m } = picture.decode()?;
                let descriptors = encoders
                    .describe(&color, depth_m.as_ref())
                    .map_err(|e| FieldError::new("color", e.to_string()))?;
                metrics::counter!("coma_place_described_total").increment(1);
                metrics::histogram!("coma_place_describe_seconds").record(begin.elapsed().as_secs_f64());
                Ok(descriptors.iter().map(Wire::to_wire).collect())
            })
            .await?;
        Ok(Response::new(v1::DescribeResponse { descriptors }))
    }

    async fn insert(
        &self,
        request: Request<v1::InsertRequest>,
    ) -> Result<Response<v1::InsertResponse>, Status> {
        let request = request.into_inner();
        let name = index_name(request.index)?;
        let at = At::Root("anchors");
        at.at_most(request.anchors.len(), MAX_ANCHORS_PER_CALL, "anchors in one call")?;
        let indices = self.indices.clone();
        let anchors_in_index = self
            .work(move || {
                let read = |(i, message)| anchor(message, &At::Root("anchors").index(i));
                let anchors = request.anchors.into_iter().enumerate().map(read).collect::<Result<_, _>>()?;
                let index = indices.get_or_make(&name);
                let inserted = index.write().unwrap_or_else(PoisonError::into_inner).insert(anchors);
                metrics::gauge!("coma_place_anchors").set(indices.anchors() as f64);
                inserted.map_err(|Full { held, new }| {
                    Status::resource_exhausted(format!(
                        "index {name:?} holds {held} anchors and has no room for {new} more \
                         (setting max_anchors_per_index)"
                    ))
                })
            })
            .await?;
        Ok(Response::new(v1::InsertResponse { anchors_in_index: anchors_in_index as u64 }))
    }

    async fn query(&self, request: Request<v1::QueryRequest>) -> Result<Response<v1::QueryResponse>, Status> {
        let request = request.into_inner();
        let name = index_name(request.index)?;
        let submap: SubmapId = At::Root("submap_id").required(request.submap_id)?;
        if request.limit > MAX_CANDIDATES {
            let message =
                format!("{} is over {MAX_CANDIDATES}; 0 asks for as many as there are", request.limit);
            return Err(FieldError::new("limit", message).into());
        }
        let limit = if request.limit == 0 { MAX_CANDIDATES } else { request.limit } as usize;
        let missing = |what: String| Status::not_found(format!("{what}: insert the anchors again"));
        let Some(index) = self.indices.get(&name) else {
            return Err(missing(format!("index {name:?} is not here")));
        };
        let asked = submap.clone();
        let found = self
            .work(move || Ok(index.read().unwrap_or_else(PoisonError::into_inner).query(&asked, limit)))
            .await?;
        let Some((candidates, strangers)) = found else {
            return Err(missing(format!("anchor {submap} is not in index {name:?}")));
        };
        let candidate = |c: coma_place::Candidate| v1::Candidate {
            submap_id: Some(if c.a == submap { c.b.to_wire() } else { c.a.to_wire() }),
            similarity: c.similarity,
            window_similarity: c.window_similarity,
            space: c.space.into(),
        };
        Ok(Response::new(v1::QueryResponse {
            candidates: candidates.into_iter().map(candidate).collect(),
            agents_without_common_space: strangers.iter().map(Wire::to_wire).collect(),
        }))
    }
}
