//! From a message to a domain type: the path to each field, and what is said when it is refused.

use std::collections::BTreeMap;
use std::fmt;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, FieldViolation, StatusExt};

/// A field that was refused, named by its path (`calibration.color.fx`, `entries[3].key.agent_id`).
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {message}")]
pub struct FieldError {
    /// The path from the request's root.
    pub field: String,
    /// What is wrong with it, with its numbers.
    pub message: String,
}

impl FieldError {
    /// A refusal of the field at `field`.
    pub fn new(field: impl Into<String>, message: impl Into<String>) -> Self {
        FieldError { field: field.into(), message: message.into() }
    }
}

/// Where in a message we are. Costs nothing until a field is refused.
#[derive(Clone, Copy, Debug)]
pub enum At<'a> {
    /// The message itself; its text is the path so far and may be empty.
    Root(&'a str),
    /// A field of what is above.
    Field(&'a At<'a>, &'a str),
    /// An element of a repeated field.
    Index(&'a At<'a>, usize),
}

impl<'a> At<'a> {
    /// The request itself.
    pub const ROOT: At<'static> = At::Root("");

    /// One step down.
    pub fn field(&'a self, name: &'a str) -> At<'a> {
        At::Field(self, name)
    }

    /// The element `index` of a repeated field.
    pub fn index(&'a self, index: usize) -> At<'a> {
        At::Index(self, index)
    }

    /// A refusal here.
    pub fn refuse(&self, message: impl Into<String>) -> FieldError {
        FieldError::new(self.to_string(), message)
    }

    /// A message field that must be there.
    pub fn required<T: Wire>(&self, message: Option<T::Message>) -> Result<T, FieldError> {
        match message {
            Some(message) => T::from_wire(message, self),
            None => Err(self.refuse("is missing")),
        }
    }

    /// A message field that may be absent.
    pub fn optional<T: Wire>(&self, message: Option<T::Message>) -> Result<Option<T>, FieldError> {
        message.map(|message| T::from_wire(message, self)).transpose()
    }

    /// A repeated field of at most `limit` elements.
    pub fn repeated<T: Wire>(&self, messages: Vec<T::Message>, limit: usize) -> Result<Vec<T>, FieldError> {
        self.at_most(messages.len(), limit, "elements")?;
        messages.into_iter().enumerate().map(|(i, message)| T::from_wire(message, &self.index(i))).collect()
    }

    /// Text of at most `limit` bytes.
    pub fn text(&self, text: String, limit: usize) -> Result<String, FieldError> {
        self.at_most(text.len(), limit, "bytes")?;
        Ok(text)
    }

    /// Named numbers, all finite, at most [`limits::NUMBERS`].
    pub fn numbers(&self, numbers: BTreeMap<String, f64>) -> Result<BTreeMap<String, f64>, FieldError> {
        self.at_most(numbers.len(), limits::NUMBERS, "elements")?;
        for (name, value) in &numbers {
            self.at_most(name.len(), limits::NAME, "bytes in a name")?;
            if !value.is_finite() {
                return Err(self.field(name).refuse(format!("{value} is not finite")));
            }
        }
        Ok(numbers)
    }

    /// Refuses more than `limit` of something.
    pub fn at_most(&self, found: usize, limit: usize, what: &str) -> Result<(), FieldError> {
        if found > limit {
            return Err(self.refuse(format!("{found} {what}, at most {limit} are taken")));
        }
        Ok(())
    }
}

impl fmt::Display for At<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            At::Root(name) => f.write_str(name),
            At::Field(At::Root(""), name) => f.write_str(name),
            At::Field(above, name) => write!(f, "{above}.{name}"),
            At::Index(above, index) => write!(f, "{above}[{index}]"),
        }
    }
}

/// A domain type that has a message in the contract.
///
/// Law: `T::from_wire(value.to_wire(), at) == Ok(value)` for every valid value, bit for bit.
pub trait Wire: Sized {
    /// Its message.
    type Message;
    /// Writes it.
    fn to_wire(&self) -> Self::Message;
    /// Checks and reads it; a refusal names the field's path, which starts with `at`.
    fn from_wire(message: Self::Message, at: &At<'_>) -> Result<Self, FieldError>;
}

/// The limits of what is taken from outside.
pub mod limits {
    /// Logs in a version vector.
    pub const LOGS: usize = 4096;
    /// Descriptors of one anchor.
    pub const DESCRIPTORS: usize = 8;
    /// Values of a descriptor.
    pub const DESCRIPTOR_VALUES: usize = 512;
    /// Named numbers of a verdict.
    pub const NUMBERS: usize = 64;
    /// Bytes of a name: reasons, builds, descriptor spaces, graphs.
    pub const NAME: usize = 128;
    /// Bytes of a sentence.
    pub const SENTENCE: usize = 1024;
    /// Bytes of an encoded payload.
    pub const PAYLOAD: usize = 256 * 1024;
    /// Bytes of a signature.
    pub const SIGNATURE: usize = 256;
    /// Metres from an origin.
    pub const DISTANCE_M: f64 = 1e7;
}

/// A field of a request, checked: `checked("frame", request.frame)?`.
pub fn checked<T: Wire>(field: &str, message: Option<T::Message>) -> Result<T, FieldError> {
    At::Root(field).required(message)
}

/// INVALID_ARGUMENT with a google.rpc.BadRequest that names the fields: the one place where refused
/// fields become a status.
pub fn invalid_fields(errors: &[FieldError]) -> Status {
    let text = errors.iter().map(FieldError::to_string).collect::<Vec<_>>().join("; ");
    let violations = errors.iter().map(|e| FieldViolation::new(&e.field, &e.message)).collect::<Vec<_>>();
    Status::with_error_details(Code::InvalidArgument, text, ErrorDetails::with_bad_request(violations))
}

/// [`invalid_fields`] of one.
pub fn invalid(error: FieldError) -> Status {
    invalid_fields(&[error])
}

impl From<FieldError> for Status {
    fn from(error: FieldError) -> Status {
        invalid(error)
    }
}

/// The fields that a server refused, if it named any.
pub fn field_errors_of(status: &Status) -> Vec<FieldError> {
    status.get_details_bad_request().map_or_else(Vec::new, |bad_request| {
        bad_request.field_violations.into_iter().map(|v| FieldError::new(v.field, v.description)).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_reads_as_one_would_write_it() {
        let entries = At::ROOT.field("entries");
        let entry = entries.index(3);
        assert_eq!(entry.field("key").to_string(), "entries[3].key");
        assert_eq!(At::Root("calibration").field("color").to_string(), "calibration.color");
        assert_eq!(At::Root("calibration").to_string(), "calibration");
    }

    #[test]
    fn a_refused_field_travels_in_the_status() {
        let error = FieldError::new("frame.depth", "12 bytes, 64 are needed");
        let status = invalid(error.clone());
        assert_eq!(status.code(), Code::InvalidArgument);
        assert_eq!(status.message(), "frame.depth: 12 bytes, 64 are needed");
        assert_eq!(field_errors_of(&status), [error]);
        assert_eq!(field_errors_of(&Status::not_found("x")), []);
    }
}
