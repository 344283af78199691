//! debug
#![allow(clippy::all, missing_docs, clippy::print_stdout)]
use burn::tensor::Tensor;
use rigscape::bev_vae::*;
use rigscape::commands::LoadedModel;
use vae::sample_points::*;
use vae::state_coder::*;
fn st<const D: usize>(n: &str, t: Tensor<D>, tok_axis: usize) {
    let m = t.clone().mean_dim(tok_axis);
    let dev = (t.clone() - m).square().mean().sqrt().into_scalar::<f32>();
    let r = t.square().mean().sqrt().into_scalar::<f32>();
    println!("{n}: rms {r:.4} token-dev {dev:.4}");
}
fn main() {
    let l = LoadedModel::open(std::path::Path::new(&std::env::args().nth(1).unwrap()), None).unwrap();
    let c = l.model.config().clone();
    let m = &l.model;
    let ds = data::open(&l.experiment.data.validation[0]).unwrap();
    let so = data::SampleOptions { size: l.experiment.image_size(), pose_mode: Default::default() };
    let b = data::assemble(
        (0..10).map(|i| data::Sample::load(&ds.frame(i * 3).unwrap(), &so).unwrap()).collect(),
        data::PadViews::Largest,
    )
    .unwrap();
    let img = vae::pixels::normalise(rigscape::tensors::pictures(&b.input, &l.device));
    let cams = rigscape::tensors::encode_cameras(&b.input, &l.device);
    let p = voxels_in_views(&c, &cams);
    let [bb, v, ch, h, w] = img.dims();
    let f = m.encoder.image.forward(img.clone().reshape([bb * v, ch, h, w]), &c);
    let [n, e, hh, ww] = f.dims();
    st("image feat", f.clone().reshape([n, e, hh * ww]), 2);
    st("image feat (views)", f.clone().reshape([n, e, hh * ww]), 0);
    let s = m.encoder.scene.forward(f, &p, &c);
    let [b2, cc, z, y, x] = s.dims();
    st("scene", s.clone().reshape([b2, cc, z * y * x]), 2);
    st("scene (samples)", s.clone().reshape([b2, cc, z * y * x]), 0);
    println!("visible share {}", p.valid.clone().float().mean().into_scalar::<f32>());
    let t = m.encoder.state.forward(s, &c);
    st("state tokens", t.clone(), 1);
    st("state (samples)", t.clone(), 0);
    let post = DiagonalGaussian::from_moments(m.pre_quant.forward(t));
    st("mean", post.mean.clone(), 1);
    st("mean (samples)", post.mean.clone(), 0);
    println!("sigma {}", (post.log_var.clone() * 0.5).exp().mean().into_scalar::<f32>());
    let d = rigscape::tensors::decode_cameras(&b.target, &l.device);
    let st2 = m.post_quant.forward(post.mean);
    st("post_quant", st2.clone(), 1);
    let sc = m.decoder.state.forward(st2, &c);
    st("scene_hat", sc.clone().reshape([b2, cc, z * y * x]), 2);
    st("scene_hat (samples)", sc.clone().reshape([b2, cc, z * y * x]), 0);
    let r = rays_in_grid(&c, &d);
    println!("valid share {}", r.valid.clone().float().mean().into_scalar::<f32>());
    let q = m.decoder.scene.queries(1, 1, &c);
    st("ray queries", q.reshape([c.frustum.depths, c.frustum.rows * c.frustum.columns, c.scene.channels]), 1);
    let ft = m.decoder.scene.forward(sc, &r, &c);
    st("ray feat", ft.clone(), 1);
    st("ray feat (views)", ft.clone(), 0);
    let (im, tok) = m.decoder.image.forward(ft, &c);
    let [n, hh, ww, e] = tok.dims();
    st("last tokens", tok.reshape([n, hh * ww, e]), 1);
    st("image", im.reshape([n, 3 * 64 * 64]), 1);
}
