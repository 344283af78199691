//! The small text encoder: padding, gradients, learning.

use burn::module::Module;
use burn::optim::{AdamConfig, GradientsParams};
use burn::tensor::{Device, Tensor};
use nn::Init;
use nn::lora::{self, LoraConfig};
use stable_diffusion::text::{
    ClipTokenizer, Padding, SmallTextConfig, SmallTextEncoder, TextCleaning, TextEncoder, TextError, Tokenizer,
    WordTokenizer,
};

use super::reference::{device, table, values};

const TEXTS: [&str; 3] = ["a rainy night", "sunny day, 12 cars", ""];

fn config(tokens: usize) -> SmallTextConfig {
    SmallTextConfig { width: 16, layers: 2, heads: 2, tokens }
}

fn encoder(tokens: usize, device: &Device) -> SmallTextEncoder {
    SmallTextEncoder::new(&config(tokens), WordTokenizer::VOCABULARY, &mut Init::new(2, device))
}

#[test]
fn padding_changes_nothing_before_it() {
    let model = encoder(40, &device());
    let (short, long) = (WordTokenizer::new(24).tokenize(&TEXTS), WordTokenizer::new(40).tokenize(&TEXTS));
    let (a, b) = (model.forward(&short), model.forward(&long));
    assert_eq!((a.states.dims(), b.states.dims()), ([3, 24, 16], [3, 40, 16]));
    for (text, length) in short.lengths().iter().enumerate() {
        let part = |states: &Tensor<3>| states.clone().narrow(0, text, 1).narrow(1, 0, *length);
        let off: f32 = (part(&a.states) - part(&b.states)).abs().max().into_scalar();
        assert!(off < 1e-6, "text {text}: {off}");
        let end: f32 = (part(&a.states).narrow(1, length - 1, 1).reshape([1, 16])
            - a.pooled.clone().narrow(0, text, 1))
        .abs()
        .max()
        .into_scalar();
        assert_eq!(end, 0.0);
    }
    assert!((a.pooled - b.pooled).abs().max().into_scalar::<f32>() < 1e-6);
}

#[test]
fn it_learns_to_tell_texts_apart() {
    let device = device().autodiff();
    let mut model = TextEncoder::Small(encoder(24, &device));
    let tokens = Tokenizer::Words(WordTokenizer::new(24)).tokenize(&TEXTS);
    let target = Tensor::<2>::from_floats([[1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]], &device);
    let mut optimizer = AdamConfig::new().init();
    let mut losses = Vec::new();
    for step in 0..40 {
        let error = model.forward(&tokens).pooled.narrow(1, 0, 2) - target.clone();
        let loss = error.square().mean();
        losses.push(values(loss.clone())[0]);
        let gradients = GradientsParams::from_grads(loss.backward(), &model);
        // Two tables, two layers of sixteen, one norm of two; keys' biases shift all scores of a query alike.
        assert_eq!(gradients.len(), 2 + 2 * 16 + 2, "step {step}");
        model = optimizer.step(1e-2, model, gradients);
    }
    assert!(losses[39] < 0.02 * losses[0], "{losses:?}");
}

#[test]
fn byte_pairs_are_used_when_there_are_any() {
    let tokenizer = config(32).tokenizer(None);
    assert!(matches!(tokenizer, Tokenizer::Words(_)));
    assert_eq!(tokenizer.context(), 32);
    let Some(pairs) = table() else { return };
    let clip = ClipTokenizer::new(pairs, TextCleaning::Transformers, Padding::EndToken);
    let tokenizer = config(32).tokenizer(Some(clip));
    assert_eq!((tokenizer.vocabulary_size(), tokenizer.context()), (49_408, 32));
    let tokens = tokenizer.tokenize(&TEXTS);
    assert_eq!((tokens.width(), tokens.lengths()), (32, [5, 8, 2].as_slice()));
    let model = SmallTextEncoder::new(&config(32), tokenizer.vocabulary_size(), &mut Init::new(2, &device()));
    assert_eq!(model.forward(&tokens).states.dims(), [3, 32, 16]);
}

#[test]
fn sizes_that_build_nothing_are_refused() {
    for wrong in [SmallTextConfig { heads: 3, ..config(8) }, config(1), SmallTextConfig { width: 0, ..config(8) }] {
        assert!(matches!(wrong.checked(), Err(TextError::Sizes(_))), "{wrong:?}");
    }
    assert!(SmallTextConfig::default().checked().is_ok());
    assert!(parsed(r#"{"width": 8, "depth": 2}"#).is_err() && parsed(r#"{"width": 8}"#).is_ok());
}

fn parsed(text: &str) -> serde_json::Result<SmallTextConfig> {
    serde_json::from_str(text)
}

#[test]
fn adapters_sit_on_the_projections() {
    let model = TextEncoder::Small(encoder(24, &device()));
    let targets = ["q_proj", "v_proj", "fc1"].map(str::to_owned).to_vec();
    let mut model = lora::attach(model, "style", &LoraConfig { rank: 2, alpha: 2.0, targets }, 0).unwrap();
    assert_eq!(lora::names(&mut model), ["style"]);
    // Per layer two projections of 16→16 and one of 16→64.
    assert_eq!(model.num_params() - encoder(24, &device()).num_params(), 2 * (2 * 2 * 32 + 2 * 80));
}
