//! Where adapters can sit: the walk over a model's affine layers.

use burn::module::Param;
use burn::tensor::{Device, Tensor};

use super::Adapters;
use crate::{Conv3x3, Linear, Mlp, PatchConv2d, RotaryAttention, RotaryBlock, RotaryStack};

/// One weight that can carry adapters.
#[derive(Debug)]
pub struct Site<'a> {
    /// Path of the layer: field names and indices joined by dots, without the parameter's own name.
    pub path: &'a str,
    /// The weight itself.
    pub weight: SiteWeight<'a>,
    /// Its adapters.
    pub lora: &'a mut Adapters,
}

/// The weight of a [`Site`].
#[derive(Debug, Clone, Copy)]
pub enum SiteWeight<'a> {
    /// `[out, in]`
    Matrix(&'a Param<Tensor<2>>),
    /// `[out, in, kh, kw]`
    Kernel(&'a Param<Tensor<4>>),
}

impl SiteWeight<'_> {
    /// `[out, in]` or `[out, in, kh, kw]`, without touching values.
    #[must_use]
    pub fn shape(&self) -> Vec<usize> {
        match self {
            Self::Matrix(weight) => weight.lazy_shape().as_slice().to_vec(),
            Self::Kernel(weight) => weight.lazy_shape().as_slice().to_vec(),
        }
    }

    pub(super) fn device(&self) -> Device {
        match self {
            Self::Matrix(weight) => weight.lazy_device(),
            Self::Kernel(weight) => weight.lazy_device(),
        }
    }

    pub(super) fn matrix(&self) -> Tensor<2> {
        match self {
            Self::Matrix(weight) => Adapters::none().matrix(weight),
            Self::Kernel(weight) => Adapters::none().matrix(weight),
        }
    }
}

/// A module that can list its affine layers. Models implement it with one line of [`lora_sites!`](crate::lora_sites)
/// per struct; layers that own a weight implement it by hand.
pub trait LoraSites {
    /// Calls `visit` with every site below `path`, in the order of fields.
    fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut(Site<'_>));
}

/// `parent.child`, or the child alone at the root.
#[must_use]
pub fn joined_path(parent: &str, child: &str) -> String {
    if parent.is_empty() { child.to_owned() } else { format!("{parent}.{child}") }
}

/// Implements [`LoraSites`](crate::lora::LoraSites) by the fields that hold affine layers.
///
/// `lora_sites!(Attention { to_q, to_k, to_v, to_out as "to_out.0" });` for a struct: `as` gives the name in released
/// files where it differs from the field's. `lora_sites!(enum Projection { Conv, Linear });` for an enum whose variants
/// hold one layer each, which adds nothing to the path.
#[macro_export]
macro_rules! lora_sites {
    (enum $type:ty { $($variant:ident),* $(,)? }) => {
        impl $crate::lora::LoraSites for $type {
            fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut($crate::lora::Site<'_>)) {
                match self {
                    $(Self::$variant(layer) => $crate::lora::LoraSites::visit_sites(layer, path, visit),)*
                }
            }
        }
    };
    ($type:ty { $($field:ident $(as $name:literal)?),* $(,)? }) => {
        impl $crate::lora::LoraSites for $type {
            fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut($crate::lora::Site<'_>)) {
                $(
                    let name = [$($name,)? stringify!($field)][0];
                    let path_of_field = $crate::lora::joined_path(path, name);
                    $crate::lora::LoraSites::visit_sites(&mut self.$field, &path_of_field, visit);
                )*
            }
        }
    };
}

impl<T: LoraSites> LoraSites for [T] {
    fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut(Site<'_>)) {
        for (index, item) in self.iter_mut().enumerate() {
            item.visit_sites(&joined_path(path, &index.to_string()), visit);
        }
    }
}

impl<T: LoraSites, const N: usize> LoraSites for [T; N] {
    fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut(Site<'_>)) {
        self.as_mut_slice().visit_sites(path, visit);
    }
}

impl<T: LoraSites> LoraSites for Vec<T> {
    fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut(Site<'_>)) {
        self.as_mut_slice().visit_sites(path, visit);
    }
}

impl<T: LoraSites> LoraSites for Option<T> {
    fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut(Site<'_>)) {
        if let Some(item) = self {
            item.visit_sites(path, visit);
        }
    }
}

/// A layer that owns one weight is one site.
macro_rules! owns_weight {
    ($($layer:ty: $kind:ident),*) => {
        $(impl LoraSites for $layer {
            fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut(Site<'_>)) {
                visit(Site { path, weight: SiteWeight::$kind(&self.weight), lora: &mut self.lora });
            }
        })*
    };
}

owns_weight!(Linear: Matrix, PatchConv2d: Kernel, Conv3x3: Kernel);
lora_sites!(Mlp { expand, contract });
lora_sites!(RotaryAttention { qkv, out });
lora_sites!(RotaryBlock { attention, mlp });
lora_sites!(RotaryStack { blocks });
