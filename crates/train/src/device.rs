//! Which backend computes: a name in the config or on the command line becomes a burn device, here and nowhere else.

use std::fmt;
use std::str::FromStr;

use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::TrainError;

/// A backend by name. Only `flex` is always compiled in; the others need the Cargo feature of the same name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DeviceConfig {
    /// Pure-Rust CPU backend.
    #[default]
    Flex,
    /// Older pure-Rust CPU backend, slow; for comparisons at small sizes.
    NdArray,
    /// WebGPU: any GPU with a Vulkan, Metal or DirectX driver, also software adapters.
    Wgpu,
    /// GPU through Vulkan and SPIR-V.
    Vulkan,
    /// GPU of an Apple machine.
    Metal,
    /// NVIDIA GPU.
    Cuda,
    /// AMD GPU.
    Rocm,
}

impl DeviceConfig {
    const ALL: [Self; 7] = [Self::Flex, Self::NdArray, Self::Wgpu, Self::Vulkan, Self::Metal, Self::Cuda, Self::Rocm];

    /// The name in configs, on the command line and of the Cargo feature.
    pub fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::NdArray => "ndarray",
            Self::Wgpu => "wgpu",
            Self::Vulkan => "vulkan",
            Self::Metal => "metal",
            Self::Cuda => "cuda",
            Self::Rocm => "rocm",
        }
    }

    /// How many micro batches of one step should be computed side by side: one per thread on flex, at least two; one on a GPU, which is
    /// busy with it, and on ndarray, which is for comparisons.
    pub fn lanes(self) -> usize {
        match self {
            Self::Flex => rayon::current_num_threads().max(2),
            Self::NdArray | Self::Wgpu | Self::Vulkan | Self::Metal | Self::Cuda | Self::Rocm => 1,
        }
    }

    /// Opens the device and runs one small operation on it, so that a missing driver shows here and not in the first
    /// training step. The device has no autodiff; training code calls `.autodiff()` on it once.
    ///
    /// # Errors
    /// [`TrainError::BackendMissing`] when the Cargo feature is off, [`TrainError::DeviceUnavailable`] when there is no
    /// adapter or driver.
    pub fn open(self) -> Result<Device, TrainError> {
        if self == Self::Flex {
            return Ok(Device::flex());
        }
        // Backends panic instead of returning an error when no adapter exists, some of them on the first operation
        // only. Nothing of ours is shared with the closure, so no broken state can leak out of a caught panic.
        let opened = std::panic::catch_unwind(move || {
            let device = self.create()?;
            let answer = Tensor::<1>::from_floats([1.0, 2.0], &device).mul_scalar(2.0).sum().try_into_scalar::<f32>();
            match answer {
                Ok(6.0) => Ok(device),
                Ok(value) => Err(self.unavailable(format!("2·1 + 2·2 came back as {value}"))),
                Err(error) => Err(self.unavailable(format!("{error:?}"))),
            }
        });
        opened.unwrap_or_else(|panic| Err(self.unavailable(panic_text(panic.as_ref()))))
    }

    #[allow(unreachable_patterns)] // with every feature on, no arm is left for "not compiled in"
    fn create(self) -> Result<Device, TrainError> {
        match self {
            Self::Flex => Ok(Device::flex()),
            #[cfg(feature = "ndarray")]
            #[allow(deprecated)] // asked for by name, for comparisons
            Self::NdArray => Ok(Device::ndarray()),
            #[cfg(feature = "wgpu")]
            Self::Wgpu => Ok(Device::wgpu(burn::tensor::DeviceKind::DefaultDevice)),
            #[cfg(feature = "vulkan")]
            Self::Vulkan => Ok(Device::vulkan(burn::tensor::DeviceKind::DefaultDevice)),
            #[cfg(feature = "metal")]
            Self::Metal => Ok(Device::metal(burn::tensor::DeviceKind::DefaultDevice)),
            #[cfg(feature = "cuda")]
            Self::Cuda => Ok(Device::cuda(burn::tensor::DeviceIndex::Default)),
            #[cfg(feature = "rocm")]
            Self::Rocm => Ok(Device::rocm(burn::tensor::DeviceIndex::Default)),
            _ => Err(TrainError::BackendMissing { device: self.name() }),
        }
    }

    fn unavailable(self, why: String) -> TrainError {
        TrainError::DeviceUnavailable { device: self.name(), why }
    }
}

impl fmt::Display for DeviceConfig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for DeviceConfig {
    type Err = TrainError;

    fn from_str(text: &str) -> Result<Self, TrainError> {
        Self::ALL.into_iter().find(|device| device.name() == text).ok_or_else(|| TrainError::UnknownDevice {
            text: text.to_string(),
            known: Self::ALL.map(Self::name).join(", "),
        })
    }
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().cloned();
    text.or_else(|| panic.downcast_ref::<&str>().map(ToString::to_string)).unwrap_or_else(|| "it panicked".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip_and_flex_opens_without_autodiff() {
        for device in DeviceConfig::ALL {
            assert_eq!(device.name().parse::<DeviceConfig>().unwrap(), device);
            let quoted = format!("{:?}", device.name());
            assert_eq!(serde_json::from_str::<DeviceConfig>(&quoted).unwrap(), device);
            assert_eq!(serde_json::to_string(&device).unwrap(), quoted);
        }
        assert!(!DeviceConfig::default().open().unwrap().is_autodiff());
        let error = "gpu".parse::<DeviceConfig>().unwrap_err().to_string();
        assert!(error.contains("gpu") && error.contains("flex") && error.contains("vulkan"), "{error}");
    }

    #[test]
    #[cfg(not(feature = "cuda"))]
    fn a_backend_that_is_not_compiled_in_names_its_feature() {
        let error = DeviceConfig::Cuda.open().unwrap_err();
        assert!(matches!(error, TrainError::BackendMissing { .. }));
        assert!(error.to_string().contains("--features cuda"), "{error}");
    }
}
