//! Choice of an engine by name and device: the native engine, or libtorch's if compiled in (feature `torch`).

use cpn::Engine;
use cpn::engine::{EngineError, Native};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

/// An engine by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum EngineKind {
    /// Hand-derived passes in Rust, on the CPU.
    Native,
    /// libtorch, on the CPU or a CUDA device, in float32.
    Torch,
}

/// A device by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Device {
    /// The processor.
    #[default]
    Cpu,
    /// A CUDA device, by its index.
    Cuda(usize),
}

/// The engine of a name on a device; by default native on the CPU, and torch on a CUDA device. On the CPU it uses `threads`
/// threads, at least one.
///
/// # Errors
/// If the engine does not support the device or is not compiled in, or the device does not exist; the error names the option.
pub fn build(engine: Option<EngineKind>, device: Device, threads: usize) -> Result<Arc<dyn Engine>, EngineError> {
    let default = if device == Device::Cpu { EngineKind::Native } else { EngineKind::Torch };
    match (engine.unwrap_or(default), device) {
        (EngineKind::Native, Device::Cpu) => Ok(Arc::new(Native { threads })),
        (EngineKind::Native, device) => {
            Err(EngineError(format!("device: expected cpu for the engine native, got {device}")))
        }
        (EngineKind::Torch, device) => torch(device, threads),
    }
}

#[cfg(feature = "torch")]
fn torch(device: Device, threads: usize) -> Result<Arc<dyn Engine>, EngineError> {
    let cuda = match device {
        Device::Cpu => None,
        Device::Cuda(index) => Some(index),
    };
    Ok(Arc::new(cpn_torch::Torch::new(cuda, threads)?))
}

#[cfg(not(feature = "torch"))]
fn torch(device: Device, _threads: usize) -> Result<Arc<dyn Engine>, EngineError> {
    Err(EngineError(format!(
        "engine: expected native on cpu, as this program is built without the feature torch, got torch on {device}"
    )))
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(index) => write!(f, "cuda:{index}"),
        }
    }
}

impl FromStr for Device {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let index = match text {
            "cpu" => return Ok(Self::Cpu),
            "cuda" => Some(0),
            _ => text.strip_prefix("cuda:").and_then(|index| index.parse().ok()),
        };
        index.map(Self::Cuda).ok_or_else(|| format!("expected cpu, cuda or cuda:N, got {text:?}"))
    }
}

impl TryFrom<String> for Device {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Device> for String {
    fn from(device: Device) -> Self {
        device.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_round_trip_through_text() {
        for text in ["cpu", "cuda:0", "cuda:12"] {
            assert_eq!(text.parse::<Device>().expect(text).to_string(), text);
        }
        assert_eq!("cuda".parse(), Ok(Device::Cuda(0)));
        for text in ["", "gpu", "cuda:", "cuda:-1", "CPU"] {
            assert_eq!(text.parse::<Device>(), Err(format!("expected cpu, cuda or cuda:N, got {text:?}")));
        }
    }

    #[test]
    fn an_unavailable_engine_or_device_is_named() {
        let error = |engine, device| build(engine, device, 1).map(drop).expect_err("no such engine").to_string();
        let native = error(Some(EngineKind::Native), Device::Cuda(0));
        assert_eq!(native, "device: expected cpu for the engine native, got cuda:0");
        let torch = error(None, Device::Cuda(99));
        let expected =
            if cfg!(feature = "torch") { "device: expected one of " } else { "engine: expected native on cpu" };
        assert!(torch.starts_with(expected), "{torch}");
    }
}
