//! From a kernel over slices to an operation on tensors with a gradient.

use std::borrow::Cow;
use std::fmt::Debug;
use std::sync::Arc;

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, DispatchTensorKind, Flex, TensorMetadata, backend_extension};
use burn::tensor::{DType, Tensor, TensorData};

/// A fused operation of `N` differentiable f32 tensors, given as contiguous row-major slices.
///
/// Results must not depend on the number of threads.
pub(crate) trait Kernel<const N: usize>: Debug + Send + Sync + 'static {
    /// Shape of the output.
    fn output_shape(&self) -> Vec<usize>;

    /// The output's values.
    fn forward(&self, inputs: [&[f32]; N]) -> Vec<f32>;

    /// The gradients of the inputs that are wanted, given the output's, whose memory may serve for one of them where it is owned.
    fn backward(&self, inputs: [&[f32]; N], upstream: Cow<'_, [f32]>, wanted: [bool; N]) -> [Option<Vec<f32>>; N];
}

/// Whether fused kernels take this tensor: f32 on the `flex` backend, with or without a tape.
pub(crate) fn on_flex<const D: usize>(tensor: &Tensor<D>) -> bool {
    if super::is_composed_only() || tensor.dtype() != DType::F32 {
        return false;
    }
    #[allow(unreachable_patterns)] // `flex` and its tape are all there is without further backend features.
    match tensor.clone().into_dispatch().kind {
        DispatchTensorKind::Flex(_) => true,
        DispatchTensorKind::Autodiff(inner) => matches!(*inner, DispatchTensorKind::Flex(_)),
        _ => false,
    }
}

/// Applies a kernel of one tensor.
pub(crate) fn fused_1<const R: usize, const O: usize>(kernel: impl Kernel<1>, a: Tensor<R>) -> Tensor<O> {
    let kernel: Arc<dyn Kernel<1>> = Arc::new(kernel);
    Tensor::from_dispatch(<burn::backend::Dispatch as FusedOps>::fused_1(a.into_dispatch(), kernel))
}

/// Applies a kernel of two tensors.
pub(crate) fn fused_2<const R: usize, const S: usize, const O: usize>(
    kernel: impl Kernel<2>,
    a: Tensor<R>,
    b: Tensor<S>,
) -> Tensor<O> {
    let kernel: Arc<dyn Kernel<2>> = Arc::new(kernel);
    Tensor::from_dispatch(<burn::backend::Dispatch as FusedOps>::fused_2(a.into_dispatch(), b.into_dispatch(), kernel))
}

/// Applies a kernel of three tensors.
pub(crate) fn fused_3<const R: usize, const S: usize, const T: usize, const O: usize>(
    kernel: impl Kernel<3>,
    a: Tensor<R>,
    b: Tensor<S>,
    c: Tensor<T>,
) -> Tensor<O> {
    let kernel: Arc<dyn Kernel<3>> = Arc::new(kernel);
    let [a, b, c] = [a.into_dispatch(), b.into_dispatch(), c.into_dispatch()];
    Tensor::from_dispatch(<burn::backend::Dispatch as FusedOps>::fused_3(a, b, c, kernel))
}

/// One method per number of inputs, since the extension macro routes tensors by argument.
#[backend_extension(Flex, Autodiff)]
trait FusedOps: Backend {
    fn fused_1(a: FloatTensor<Self>, kernel: Arc<dyn Kernel<1>>) -> FloatTensor<Self>;
    fn fused_2(a: FloatTensor<Self>, b: FloatTensor<Self>, kernel: Arc<dyn Kernel<2>>) -> FloatTensor<Self>;
    fn fused_3(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        kernel: Arc<dyn Kernel<3>>,
    ) -> FloatTensor<Self>;
}

impl FusedOps for Flex {
    fn fused_1(a: FloatTensor<Self>, kernel: Arc<dyn Kernel<1>>) -> FloatTensor<Self> {
        run(&[a], kernel.as_ref())
    }

    fn fused_2(a: FloatTensor<Self>, b: FloatTensor<Self>, kernel: Arc<dyn Kernel<2>>) -> FloatTensor<Self> {
        run(&[a, b], kernel.as_ref())
    }

    fn fused_3(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        kernel: Arc<dyn Kernel<3>>,
    ) -> FloatTensor<Self> {
        run(&[a, b, c], kernel.as_ref())
    }
}

impl<C: CheckpointStrategy> FusedOps for Autodiff<Flex, C> {
    fn fused_1(a: FloatTensor<Self>, kernel: Arc<dyn Kernel<1>>) -> FloatTensor<Self> {
        track::<1, C>([a], kernel)
    }

    fn fused_2(a: FloatTensor<Self>, b: FloatTensor<Self>, kernel: Arc<dyn Kernel<2>>) -> FloatTensor<Self> {
        track::<2, C>([a, b], kernel)
    }

    fn fused_3(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        kernel: Arc<dyn Kernel<3>>,
    ) -> FloatTensor<Self> {
        track::<3, C>([a, b, c], kernel)
    }
}

/// The contiguous form of a tensor; shares the storage where it already is.
fn contiguous<const N: usize>(tensors: &[FloatTensor<Flex>; N]) -> [FloatTensor<Flex>; N] {
    tensors.each_ref().map(|tensor| tensor.to_contiguous())
}

fn slices<const N: usize>(tensors: &[FloatTensor<Flex>; N]) -> [&[f32]; N] {
    tensors.each_ref().map(|tensor| tensor.as_slice::<f32>().expect("a contiguous f32 tensor"))
}

fn tensor(values: Vec<f32>, shape: Vec<usize>) -> FloatTensor<Flex> {
    Flex::float_from_data(TensorData::new(values, shape), &Default::default())
}

fn run<const N: usize>(inputs: &[FloatTensor<Flex>; N], kernel: &dyn Kernel<N>) -> FloatTensor<Flex> {
    let inputs = contiguous(inputs);
    tensor(kernel.forward(slices(&inputs)), kernel.output_shape())
}

/// The backward step of every fused kernel.
#[derive(Debug)]
struct FusedBackward<const N: usize>;

/// What the backward step keeps: the kernel and its inputs, no intermediate result.
#[derive(Debug, Clone)]
struct Kept<const N: usize> {
    kernel: Arc<dyn Kernel<N>>,
    inputs: [FloatTensor<Flex>; N],
}

fn track<const N: usize, C: CheckpointStrategy>(
    inputs: [FloatTensor<Autodiff<Flex, C>>; N],
    kernel: Arc<dyn Kernel<N>>,
) -> FloatTensor<Autodiff<Flex, C>> {
    let guards = inputs.each_ref().map(|input| input.node());
    let inputs = contiguous(&inputs.map(|input| input.into_primitive()));
    let output = run(&inputs, kernel.as_ref());
    match FusedBackward::<N>.prepare::<C>(guards).compute_bound().stateful() {
        OpsKind::Tracked(step) => step.finish(Kept { kernel, inputs }, output),
        OpsKind::UnTracked(step) => step.finish(output),
    }
}

impl<const N: usize> Backward<Flex, N> for FusedBackward<N> {
    type State = Kept<N>;

    fn backward(self, ops: Ops<Kept<N>, N>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let Kept { kernel, inputs } = ops.state;
        let upstream = grads.consume::<Flex>(&ops.node);
        // Two handles would make every gradient look shared.
        let upstream = if upstream.is_contiguous() { upstream } else { upstream.to_contiguous() };
        let shared;
        let upstream = if upstream.is_unique() {
            Cow::Owned(upstream.into_data().try_into_vec::<f32>().expect("an f32 tensor"))
        } else {
            shared = [upstream];
            let [upstream] = slices(&shared);
            Cow::Borrowed(upstream)
        };
        let wanted = ops.parents.each_ref().map(|parent| parent.is_some());
        let gradients = kernel.backward(slices(&inputs), upstream, wanted);
        for ((parent, input), gradient) in ops.parents.into_iter().zip(&inputs).zip(gradients) {
            if let (Some(parent), Some(gradient)) = (parent, gradient) {
                grads.register::<Flex>(parent.id, tensor(gradient, input.shape().to_vec()));
            }
        }
    }
}
