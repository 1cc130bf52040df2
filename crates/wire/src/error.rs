//! The one error that services answer with, over zenoh and gRPC alike.

use crate::proto;
use prost::Message as _;

/// Longest `expected` and `got`, in bytes: a stranger's text may be in them, and they travel in gRPC headers, where a long
/// one would end the whole connection.
const MAX_TEXT_BYTES: usize = 500;

/// What kind of fault it is; each is the gRPC status of the same name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Code {
    /// The request itself is wrong and will stay wrong.
    InvalidArgument,
    /// What the request names does not exist.
    NotFound,
    /// The request does not fit the state of the service.
    FailedPrecondition,
    /// A queue or size limit is reached: try again later.
    ResourceExhausted,
    /// The request's deadline passed.
    DeadlineExceeded,
    /// Nobody answered: try again.
    Unavailable,
    /// A fault of the service itself.
    Internal,
}

/// Why a request was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: expected {expected}, got {got}")]
pub struct Error {
    /// The kind of fault.
    pub code: Code,
    /// The request's field at fault, for example `observation.data`.
    pub field: String,
    /// What would have been right.
    pub expected: String,
    /// What came.
    pub got: String,
}

impl Error {
    /// An error of the given kind about a field; what is too long is cut.
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

    /// A request that is wrong in a field.
    pub fn invalid(field: impl Into<String>, expected: impl ToString, got: impl ToString) -> Self {
        Self::new(Code::InvalidArgument, field, expected, got)
    }

    /// The same error about a field of the message that holds this one.
    #[must_use]
    pub fn within(mut self, outer: &str) -> Self {
        self.field = if self.field.is_empty() { outer.to_owned() } else { format!("{outer}.{}", self.field) };
        self
    }

    /// The field at fault if it is missing from its message.
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
    /// Reads the details of a status that a CPN service sent; any other is a fault of the transport.
    fn from(status: tonic::Status) -> Self {
        match proto::Error::decode(status.details()) {
            Ok(error) if !status.details().is_empty() => error.into(),
            _ => Self::new(Code::Unavailable, "transport", "an answer", status),
        }
    }
}
