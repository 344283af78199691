//! The UNet in segments: gradients with the memory of one residual block and its attention.
//!
//! Paper: Chen et al., "Training Deep Nets with Sublinear Memory Cost", section 4. Parity with the whole tape: `tests/it/segments.rs`.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use nn::segments::{SegmentGraph, Slot};

use super::blocks::Condition;
use super::model::{UNet2DCondition, UNetInputs, condition};
use crate::controlnet::ControlResiduals;
use crate::cross_view::Adjacency;
use crate::panels::{join_width, split_width};

/// A forward pass that kept what is needed to differentiate it segment by segment.
pub struct SegmentedUNet<'a> {
    graph: SegmentGraph<'a>,
    sample: Slot,
    context: Slot,
    control: Option<(Vec<Slot>, Slot)>,
    output: Slot,
}

/// Gradients of a loss on the UNet's prediction, without a tape.
pub struct UNetGradients {
    /// Of the noisy latent, `[N, in, h, w]`.
    pub sample: Tensor<4>,
    /// Of the text tokens, `[N, L, context width]`.
    pub context: Tensor<3>,
    /// Of what ControlNets added.
    pub control: Option<ControlResiduals>,
    /// Of the parameters that learn.
    pub params: GradientsParams,
}

/// What every block is told, as values of the graph.
struct Told<'a> {
    time: Slot,
    context: Slot,
    views: Option<&'a Adjacency>,
    joined: usize,
}

/// What blocks read from the graph behind their state.
fn condition_of<'a>(inputs: &[Tensor<4>], views: Option<&'a Adjacency>, joined: usize) -> Condition<'a> {
    let [time, context] = inputs else { unreachable!("every block reads time and context last") };
    let ([n, _, _, width], [m, _, tokens, depth]) = (time.dims(), context.dims());
    let (time, context) = (time.clone().reshape([n, width]), context.clone().reshape([m, tokens, depth]));
    Condition { time, context, views, joined }
}

impl<'a> Told<'a> {
    /// One segment: a module that maps its first values, told the condition, to the next state.
    fn block<M: Module + 'a>(
        &self,
        graph: &mut SegmentGraph<'a>,
        (module, reads): (M, &[Slot]),
        run: impl Fn(&M, &[Tensor<4>], &Condition) -> Tensor<4> + 'a,
    ) -> Slot {
        let (views, joined, count) = (self.views, self.joined, reads.len());
        let reads = [reads, &[self.time, self.context]].concat();
        graph.segment(module, &reads, move |module, inputs| {
            vec![run(module, &inputs[..count], &condition_of(&inputs[count..], views, joined))]
        })[0]
    }
}

impl UNet2DCondition {
    /// The prediction of [`UNet2DCondition::forward_with`], with what its gradients need and no tape.
    ///
    /// `self` is given as it is trained; `sample` and everything in `inputs` come without a tape.
    ///
    /// # Panics
    /// As [`UNet2DCondition::forward_with`].
    #[must_use]
    pub fn forward_segments<'a>(&self, sample: Tensor<4>, inputs: &UNetInputs<'a>) -> SegmentedUNet<'a> {
        let [n, tokens, depth] = inputs.context.dims();
        let mut graph = SegmentGraph::default();
        let start = graph.input(sample.clone());
        let context = graph.input(inputs.context.clone().reshape([n, 1, tokens, depth]));
        let control = inputs.control.map(|control| {
            let down = control.down.iter().map(|residual| graph.input(residual.clone())).collect::<Vec<_>>();
            (down, graph.input(control.middle.clone()))
        });
        let told = self.tell(&mut graph, (&sample, context), inputs);
        let joined = told.joined;
        let first = graph.segment(self.conv_in.clone(), &[start], move |conv, inputs| {
            vec![conv.forward(join_width(inputs[0].clone(), joined))]
        })[0];
        let (mut skips, mut x) = self.encode_segments(&mut graph, &told, first);
        if let Some((down, middle)) = &control {
            assert_eq!(down.len(), skips.len(), "one residual per skip");
            skips = skips.into_iter().zip(down).map(|(skip, residual)| graph.sum(skip, *residual)).collect();
            x = graph.sum(x, *middle);
        }
        let x = self.decode_segments(&mut graph, &told, skips, x);
        let last = (self.conv_norm_out.clone(), self.conv_out.clone());
        let output = graph.segment(last, &[x], move |(norm, conv), inputs| {
            vec![split_width(conv.forward(norm.forward_silu(inputs[0].clone())), joined)]
        })[0];
        SegmentedUNet { graph, sample: start, context, control, output }
    }

    fn tell<'a>(
        &self,
        graph: &mut SegmentGraph<'a>,
        (sample, context): (&Tensor<4>, Slot),
        inputs: &UNetInputs<'a>,
    ) -> Told<'a> {
        let encoder = &self.config().encoder;
        let text = &inputs.context;
        let checked =
            condition(sample, encoder, &self.time_embedding.clone().valid(), (inputs.timesteps, text, inputs.views));
        let joined = checked.joined;
        let times: Vec<f64> = inputs.timesteps.iter().step_by(joined).copied().collect();
        let time = graph.segment(self.time_embedding.clone(), &[], move |embedding, _| {
            let time = ops::silu(embedding.forward(&times, &embedding.linear_1.weight.device()));
            let [n, width] = time.dims();
            vec![time.reshape([n, 1, 1, width])]
        })[0];
        Told { time, context, views: inputs.views, joined }
    }

    fn encode_segments<'a>(&self, graph: &mut SegmentGraph<'a>, told: &Told<'a>, first: Slot) -> (Vec<Slot>, Slot) {
        let (mut skips, mut x) = (vec![first], first);
        for level in &self.down_blocks {
            for (j, resnet) in level.resnets.iter().enumerate() {
                let part = (resnet.clone(), level.attentions.get(j).cloned());
                x = told.block(graph, (part, &[x]), |(resnet, attention), inputs, condition| {
                    let x = resnet.forward(inputs[0].clone(), Some(&condition.time));
                    attention.iter().fold(x, |x, attention| attention.forward(x, condition))
                });
                skips.push(x);
            }
            if let Some(downsampler) = &level.downsampler {
                x = graph.segment(downsampler.clone(), &[x], |down, inputs| vec![down.forward(inputs[0].clone())])[0];
                skips.push(x);
            }
        }
        let middle = told.block(graph, (self.mid_block.clone(), &[x]), |block, inputs, condition| {
            block.forward(inputs[0].clone(), condition)
        });
        (skips, middle)
    }

    fn decode_segments<'a>(
        &self,
        graph: &mut SegmentGraph<'a>,
        told: &Told<'a>,
        mut skips: Vec<Slot>,
        mut x: Slot,
    ) -> Slot {
        for level in &self.up_blocks {
            for (j, resnet) in level.resnets.iter().enumerate() {
                let skip = skips.pop().expect("a skip per residual block of the decoder");
                let part = (resnet.clone(), level.attentions.get(j).cloned());
                x = told.block(graph, (part, &[x, skip]), |(resnet, attention), inputs, condition| {
                    let x = resnet.forward(Tensor::cat(inputs.to_vec(), 1), Some(&condition.time));
                    attention.iter().fold(x, |x, attention| attention.forward(x, condition))
                });
            }
            if let (Some(upsampler), Some(next)) = (&level.upsampler, skips.last()) {
                let [_, _, h, w] = graph.value(*next).dims();
                let up = move |up: &crate::layers::Upsample, inputs: &[Tensor<4>]| {
                    vec![up.forward(inputs[0].clone(), [h, w])]
                };
                x = graph.segment(upsampler.clone(), &[x], up)[0];
            }
        }
        x
    }
}

impl SegmentedUNet<'_> {
    /// The prediction, `[N, out, h, w]`, without a tape.
    #[must_use]
    pub fn output(&self) -> Tensor<4> {
        self.graph.value(self.output)
    }

    /// Gradients of a loss from its gradient at the prediction. `network` holds the UNet as it is trained, and may hold more.
    #[must_use]
    pub fn backward<N: Module>(self, network: &N, upstream: Tensor<4>) -> UNetGradients {
        let Self { graph, sample, context, control, output } = self;
        let (down, middle) = control.map_or((vec![], None), |(down, middle)| (down, Some(middle)));
        let wanted: Vec<Slot> = [sample, context].into_iter().chain(down).chain(middle).collect();
        let zeros: Vec<Tensor<4>> = wanted.iter().map(|slot| graph.value(*slot).zeros_like()).collect();
        let (found, params) = graph.backward(network, vec![(output, upstream)], &wanted);
        let mut all = found.into_iter().zip(zeros).map(|(found, zero)| found.unwrap_or(zero));
        let (sample, context) = (all.next().expect("sample"), all.next().expect("context"));
        let [n, _, tokens, depth] = context.dims();
        let mut control: Vec<Tensor<4>> = all.collect();
        let control = control.pop().map(|middle| ControlResiduals { down: control, middle });
        UNetGradients { sample, context: context.reshape([n, tokens, depth]), control, params }
    }
}
