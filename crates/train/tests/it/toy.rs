//! A small adversarial task with two models, two optimizers, a moving average, noise and a seeded data source.

use std::collections::BTreeMap;
use std::path::Path;

use burn::module::Module;
use burn::nn::{Linear, LinearConfig};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData, activation};
use rand_chacha::rand_core::Rng;
use train::{
    BatchSource, CheckpointReader, CheckpointWriter, Ema, EmaConfig, GradientMean, Optimizer, OptimizerConfig, Scalars,
    Schedule, ScheduleShape, StepContext, StepOutput, Task, TrainError, map_parameters, stream,
};

const BATCH: usize = 6;

/// `count` numbers in [-1, 1).
pub fn uniform(rng: &mut impl Rng, count: usize) -> Vec<f32> {
    (0..count).map(|_| (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0).collect()
}

#[derive(Module, Debug)]
pub struct Generator {
    pub hidden: Linear,
    pub output: Linear,
}

impl Generator {
    fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self.output.forward(activation::silu(self.hidden.forward(x)))
    }
}

pub fn filled<M: Module>(module: M, seed: u64) -> M {
    map_parameters(module, |info, old| {
        let values = uniform(&mut stream(seed, &info.path, 0), info.len());
        Tensor::from_floats(values.as_slice(), &old.device()).mul_scalar(0.5)
    })
}

pub struct Toy {
    pub device: Device,
    pub generator: Generator,
    pub critic: Linear,
    pub optimizers: [Optimizer; 2],
    pub ema: Ema,
    /// First number of every batch, in order.
    pub seen: Vec<f32>,
    /// Data of these steps are NaN.
    pub poisoned: Vec<u64>,
    /// Answers of `validate` by step; the distance to the target otherwise.
    pub scripted: BTreeMap<u64, f64>,
}

impl Toy {
    pub fn new(seed: u64) -> Self {
        let device = Device::flex().autodiff();
        let generator =
            Generator { hidden: LinearConfig::new(4, 8).init(&device), output: LinearConfig::new(8, 2).init(&device) };
        let generator = filled(generator, seed);
        let critic = filled(LinearConfig::new(2, 1).init(&device), seed + 1);
        let schedule = Schedule { warmup_steps: 3, shape: ScheduleShape::Cosine { floor: 0.1 } };
        let config = OptimizerConfig { learning_rate: 1e-2, schedule, ..OptimizerConfig::default() };
        Self {
            ema: Ema::new(EmaConfig { decay: 0.9, warmup: true }, &generator),
            generator,
            critic,
            optimizers: [Optimizer::new(&config), Optimizer::new(&config)],
            device,
            seen: Vec::new(),
            poisoned: Vec::new(),
            scripted: BTreeMap::new(),
        }
    }

    fn inputs(&self, values: &[f32], ctx: &StepContext) -> Tensor<2> {
        let clean = Tensor::<2>::from_data(TensorData::new(values.to_vec(), [BATCH, 4]), &self.device);
        let noise = uniform(&mut ctx.stream("noise"), BATCH * 4);
        clean + Tensor::from_data(TensorData::new(noise, [BATCH, 4]), &self.device).mul_scalar(0.01)
    }

    fn distance(&self, x: Tensor<2>, generator: &Generator) -> Tensor<1> {
        let target = x.clone().narrow(1, 0, 2) * x.clone().narrow(1, 2, 2);
        (generator.forward(x) - target).powi_scalar(2).mean()
    }
}

impl Task for Toy {
    type Batch = Vec<f32>;

    fn train_step(&mut self, batches: Vec<Vec<f32>>, ctx: &StepContext) -> Result<StepOutput, TrainError> {
        let mut output = StepOutput::new(BATCH * batches.len());
        let mut mean = GradientMean::default();
        for mut batch in batches {
            self.seen.push(batch[0]);
            if self.poisoned.contains(&ctx.step) {
                batch[0] = f32::NAN;
            }
            let x = self.inputs(&batch, ctx);
            let fake = self.generator.forward(x.clone());
            let loss = self.distance(x, &self.generator) - self.critic.forward(fake).mean().mul_scalar(0.1);
            mean.add(&self.generator, GradientsParams::from_grads(loss.backward(), &self.generator));
            output.push("loss", loss);
        }
        let grads = mean.take(&self.generator);
        let (generator, update) = self.optimizers[0].update(self.generator.clone(), grads, ctx)?;
        self.generator = generator;
        if !update.skipped {
            self.ema.update(&self.generator);
        }
        output.push("gradient_norm", update.gradient_norm);
        let fake = self.generator.forward(self.inputs(&[0.5; BATCH * 4], ctx)).detach();
        let loss = self.critic.forward(fake).powi_scalar(2).mean();
        let grads = GradientsParams::from_grads(loss.backward(), &self.critic);
        self.critic = self.optimizers[1].update(self.critic.clone(), grads, ctx)?.0;
        output.push("critic", loss);
        Ok(output)
    }

    fn validate(&mut self, ctx: &StepContext) -> Result<Scalars, TrainError> {
        let x = Tensor::from_data(TensorData::new(vec![0.3; BATCH * 4], [BATCH, 4]), &self.device.clone().inner());
        let own = self.distance(x, &self.ema.apply(self.generator.valid())).into_scalar::<f32>().into();
        Ok(vec![("distance".into(), self.scripted.get(&ctx.step).copied().unwrap_or(own))])
    }

    fn preview(&mut self, folder: &Path, ctx: &StepContext) -> Result<(), TrainError> {
        std::fs::write(folder.join("preview.txt"), ctx.step.to_string()).map_err(TrainError::task)
    }

    fn save(&self, writer: &mut CheckpointWriter) -> Result<(), TrainError> {
        writer.module("model", &self.generator)?;
        writer.module("discriminator", &self.critic)?;
        self.ema.save(writer, "ema")?;
        self.optimizers[0].save(writer, "optimizer_generator")?;
        self.optimizers[1].save(writer, "optimizer_discriminator")
    }

    fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError> {
        self.generator = reader.module("model", self.generator.clone())?;
        self.critic = reader.module("discriminator", self.critic.clone())?;
        self.ema.load(reader, "ema", &self.generator)?;
        self.optimizers[0].load(reader, "optimizer_generator", &self.generator)?;
        self.optimizers[1].load(reader, "optimizer_discriminator", &self.critic)
    }
}

/// Batches as a function of (seed, position).
pub struct Numbers {
    pub seed: u64,
    pub position: u64,
}

impl BatchSource for Numbers {
    type Batch = Vec<f32>;

    fn next(&mut self) -> Result<Vec<f32>, TrainError> {
        self.position += 1;
        Ok(uniform(&mut stream(self.seed, "data", self.position - 1), BATCH * 4))
    }

    fn position(&self) -> u64 {
        self.position
    }
}
