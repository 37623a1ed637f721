//! Recognising places: which two views may show the same one.
//!
//! * [`descriptor`]: what an image looks like in at most 512 bytes; only descriptors of one [`Space`] compare.
//! * [`encoder`]: the trait behind which image encoders stand; [`builtin`] needs no download.
//! * [`index`]: the most similar descriptors, by exact search; `large` (feature `usearch`) for some 10^5 and more.
//! * [`candidates`]: pairs worth a geometric verification (temporal filter, thresholds, windows of anchors).
//!
//! No encoder is safe alone: thresholds favour recall, and registration decides.

pub mod builtin;
pub mod candidates;
pub mod descriptor;
pub mod encoder;
pub mod index;
#[cfg(feature = "usearch")]
pub mod large;
mod saved;

pub use builtin::Builtin;
pub use candidates::{Candidate, Candidates, Filter, Settings};
pub use descriptor::{Descriptor, DescriptorError, Space, similarity};
pub use encoder::{EncodeError, Encoder, Thresholds};
pub use index::{ExactIndex, Hit, Index};
#[cfg(feature = "usearch")]
pub use large::LargeIndex;
pub use saved::SavedError;
