//! Error type of all services, over zenoh and gRPC alike.

use crate::proto;
use prost::Message as _;

/// Longest `expected` and `got`, in bytes: both may quote untrusted text, and they travel in gRPC headers, where an overlong
/// one would end the whole connection.
const MAX_TEXT_BYTES: usize = 500;

/// Error code; each is the gRPC status of the same name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Code {
    /// Invalid request; retrying does not help.
    InvalidArgument,
    /// Unknown name or id.
    NotFound,
    /// Request that does not fit the state of the service.
    FailedPrecondition,
    /// Full queue or exceeded size limit: retry later.
    ResourceExhausted,
    /// Expired deadline.
    DeadlineExceeded,
    /// No answer: retry.
    Unavailable,
    /// Fault of the service itself.
    Internal,
}

/// Refusal of a request.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: expected {expected}, got {got}")]
pub struct Error {
    /// Error code.
    pub code: Code,
    /// Path of the field at fault in the request, for example `observation.data`.
    pub field: String,
    /// Description of a valid value.
    pub expected: String,
    /// The value that came.
    pub got: String,
}

impl Error {
    /// Error about a field; overlong `expected` and `got` are truncated.
    pub fn new(code: Code, field: impl Into<String>, expected: impl ToString, got: impl ToString) -> Self {
        let cut = |mut text: String| {
            if text.len() > MAX_TEXT_BYTES {
                text.truncate(text.floor_char_boundary(MAX_TEXT_BYTES));
                text.push('…');
            }
            text
        };
        Self { code, field: field.into(), expected: cut(expected.to_string()), got: cut(got.to_string()) }
    }

    /// [`Code::InvalidArgument`] about a field.
    pub fn invalid(field: impl Into<String>, expected: impl ToString, got: impl ToString) -> Self {
        Self::new(Code::InvalidArgument, field, expected, got)
    }

    /// The same error, with the field's path prefixed by that of the enclosing message.
    #[must_use]
    pub fn within(mut self, outer: &str) -> Self {
        self.field = if self.field.is_empty() { outer.to_owned() } else { format!("{outer}.{}", self.field) };
        self
    }

    /// [`Code::InvalidArgument`] about a missing field.
    pub(crate) fn missing(field: &str) -> Self {
        Self::invalid(field, "a value", "none")
    }
}

impl From<Code> for proto::ErrorCode {
    fn from(code: Code) -> Self {
        match code {
            Code::InvalidArgument => Self::InvalidArgument,
            Code::NotFound => Self::NotFound,
            Code::FailedPrecondition => Self::FailedPrecondition,
            Code::ResourceExhausted => Self::ResourceExhausted,
            Code::DeadlineExceeded => Self::DeadlineExceeded,
            Code::Unavailable => Self::Unavailable,
            Code::Internal => Self::Internal,
        }
    }
}

impl From<proto::ErrorCode> for Code {
    fn from(code: proto::ErrorCode) -> Self {
        match code {
            proto::ErrorCode::InvalidArgument => Self::InvalidArgument,
            proto::ErrorCode::NotFound => Self::NotFound,
            proto::ErrorCode::FailedPrecondition => Self::FailedPrecondition,
            proto::ErrorCode::ResourceExhausted => Self::ResourceExhausted,
            proto::ErrorCode::DeadlineExceeded => Self::DeadlineExceeded,
            proto::ErrorCode::Unavailable => Self::Unavailable,
            proto::ErrorCode::Internal | proto::ErrorCode::Unspecified => Self::Internal,
        }
    }
}

impl From<Error> for proto::Error {
    fn from(error: Error) -> Self {
        let Error { code, field, expected, got } = error;
        Self { code: proto::ErrorCode::from(code).into(), field, expected, got }
    }
}

impl From<proto::Error> for Error {
    fn from(error: proto::Error) -> Self {
        Self { code: error.code().into(), field: error.field, expected: error.expected, got: error.got }
    }
}

impl From<Error> for tonic::Status {
    fn from(error: Error) -> Self {
        let code = match error.code {
            Code::InvalidArgument => tonic::Code::InvalidArgument,
            Code::NotFound => tonic::Code::NotFound,
            Code::FailedPrecondition => tonic::Code::FailedPrecondition,
            Code::ResourceExhausted => tonic::Code::ResourceExhausted,
            Code::DeadlineExceeded => tonic::Code::DeadlineExceeded,
            Code::Unavailable => tonic::Code::Unavailable,
            Code::Internal => tonic::Code::Internal,
        };
        let message = error.to_string();
        Self::with_details(code, message, proto::Error::from(error).encode_to_vec().into())
    }
}

impl From<tonic::Status> for Error {
    /// Decodes the details of a CPN service's status; a status without them is an error of the transport.
    fn from(status: tonic::Status) -> Self {
        match proto::Error::decode(status.details()) {
            Ok(error) if !status.details().is_empty() => error.into(),
            _ => Self::new(Code::Unavailable, "transport", "an answer", status),
        }
    }
}
