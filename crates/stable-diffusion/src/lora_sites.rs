//! Which layers can carry low-rank adapters, under the names that diffusers gives them.

use nn::lora::{LoraSites, Site, SiteWeight, joined_path};
use nn::lora_sites;

use crate::layers::{Conv2d, Downsample, Upsample};
use crate::unet::{
    DownBlock, FeedForward, MidBlock, Projection, TimeEmbedding, Transformer2d, TransformerBlock, UNet2DCondition,
    UpBlock,
};
use crate::{Attention, ControlNet, CrossView, ResnetBlock};

impl LoraSites for Conv2d {
    fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut(Site<'_>)) {
        visit(Site { path, weight: SiteWeight::Kernel(&self.weight), lora: &mut self.lora });
    }
}

lora_sites!(Downsample { conv });
lora_sites!(Upsample { conv });
lora_sites!(ResnetBlock { conv1, time_emb_proj, conv2, conv_shortcut });
lora_sites!(Attention { to_q, to_k, to_v, to_out as "to_out.0" });
lora_sites!(CrossView { attn4, connector });
lora_sites!(FeedForward { expand as "net.0.proj", contract as "net.2" });
lora_sites!(
    enum Projection {
        Convolution,
        Linear,
    }
);
lora_sites!(Transformer2d { proj_in, transformer_blocks, proj_out });
lora_sites!(DownBlock { resnets, attentions, downsampler as "downsamplers.0" });
lora_sites!(MidBlock { resnets, attentions });
lora_sites!(UpBlock { resnets, attentions, upsampler as "upsamplers.0" });
lora_sites!(TimeEmbedding { linear_1, linear_2 });
lora_sites!(UNet2DCondition { conv_in, time_embedding, down_blocks, mid_block, up_blocks, conv_out });
lora_sites!(ControlNet {
    conv_in,
    time_embedding,
    down_blocks,
    mid_block,
    controlnet_down_blocks,
    controlnet_mid_block
});

impl LoraSites for TransformerBlock {
    fn visit_sites(&mut self, path: &str, visit: &mut dyn FnMut(Site<'_>)) {
        self.attn1.visit_sites(&joined_path(path, "attn1"), visit);
        self.attn2.visit_sites(&joined_path(path, "attn2"), visit);
        // Its parameters lie beside those of the block in a state dict.
        self.cross_view.visit_sites(path, visit);
        self.ff.visit_sites(&joined_path(path, "ff"), visit);
    }
}
