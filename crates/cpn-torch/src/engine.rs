//! Engine of libtorch: plans and training on the processor or a CUDA device.

use crate::learner::TorchLearner;
use crate::planner::TorchPlanner;
use cpn::engine::{Engine, EngineError};
use cpn::{Learner, Method, Model, Precision, Training};
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use tch::{Cuda, Device};

/// libtorch's engine on one device, in float32.
#[derive(Debug, Clone, Copy)]
pub struct Torch {
    device: Device,
    threads: usize,
}

impl Torch {
    /// An engine on the processor, with `threads` threads, or on a CUDA device, by its index.
    ///
    /// # Errors
    /// If the device does not exist, or libtorch is built without CUDA.
    pub fn new(cuda: Option<usize>, threads: usize) -> Result<Self, EngineError> {
        let Some(index) = cuda else { return Ok(Self { device: Device::Cpu, threads }) };
        let count = if Cuda::is_available() { Cuda::device_count() } else { 0 };
        if (index as i64) < count {
            Ok(Self { device: Device::Cuda(index), threads })
        } else {
            Err(EngineError(format!("device: expected one of {count} CUDA devices, got cuda:{index}")))
        }
    }
}

impl Engine for Torch {
    fn planner(&self, model: &Model, _precision: Precision) -> Result<Box<dyn Method>, EngineError> {
        let planner = on_device(self.device, || TorchPlanner::new(model, self.device, self.threads));
        Ok(Box::new(planner.map_err(EngineError)?))
    }

    fn learner(&self, model: Model, training: &Training) -> Result<Box<dyn Learner>, EngineError> {
        let learner = on_device(self.device, || TorchLearner::new(&model, training, self.device, self.threads));
        Ok(Box::new(learner.map_err(EngineError)?))
    }
}

/// Runs operations of libtorch. `tch` panics if one fails, for example if the device is out of memory; the panic becomes an error.
pub fn on_device<T>(device: Device, run: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(run)).map_err(|panic| format!("device {}: {}", name(device), message(&*panic)))
}

fn name(device: Device) -> String {
    match device {
        Device::Cuda(index) => format!("cuda:{index}"),
        _ => "cpu".to_owned(),
    }
}

/// The first line of a panic's message, without the C++ trace after it.
fn message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
    text.and_then(|text| text.lines().next()).unwrap_or("failed")
}
