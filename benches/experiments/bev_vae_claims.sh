#!/bin/sh
# The BEV-VAE paper's claims at toy size on the procedural world:
#   a  trained on three rigs mixed against trained on one, on that one's held-out scenes (Table 2)
#   b  an unseen five-camera fisheye rig: as it is, and after a short fine-tuning (Table 3)
#   c  views turned by 30 degrees, decoding for another rig, and the same with one camera fewer, against rendered truth
# Usage, from the repository: [STEPS=2000] [TUNE_STEPS=300] [SEEDS="1 2 3"] [FRAMES=0] benches/experiments/bev_vae_claims.sh OUT_DIR
# Everything lands in OUT_DIR; OUT_DIR/table.md holds the numbers. A run that is there already is not repeated.
set -eu
out=${1:?say where results go}
steps=${STEPS:-2000}
tune_steps=${TUNE_STEPS:-300}
seeds=${SEEDS:-1 2 3}
frames=${FRAMES:-0}
here=$(dirname "$0")
cargo build --release --bins
bin=${CARGO_TARGET_DIR:-target}/release
mkdir -p "$out"

held_out() { # name, seed, rig, further settings
    printf '[[data]]\nkind = "procedural"\nname = "%s"\nseed = %s\nscenes = 16\nframes_per_scene = 1\nrig = { preset = "%s" }\n%s\n' "$1" "$2" "$3" "$4" > "$out/$1.toml"
}
held_out six 1001 nuscenes ''
held_out five-fisheye 1004 wayve_scenes101 ''
held_out six-without-front 1001 nuscenes 'cameras = ["CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT"]'

learn() { # run, steps, further options
    name=$1
    length=$2
    shift 2
    [ -f "$out/$name/summary.json" ] && return
    rm -rf "${out:?}/$name"
    "$bin/train-vae" --config "$here/three_rigs.toml" --set "run.root=$out" --set "run.name=$name" --set "train.steps=$length" "$@"
}
measure() { # run, data, report
    [ -f "$out/$3/report.json" ] || "$bin/rigscape" evaluate --checkpoint "$out/$1" --data "$out/$2.toml" --frames "$frames" --protocol psnr/bev-vae,ssim/gauss11 --out "$out/$3"
}
decode() { # run, data, sheet: the asked rig against its rendering
    [ -f "$out/$3.txt" ] || "$bin/rigscape" change-rig --checkpoint "$out/$1" --data "$out/$2.toml" --rig "$4" --frames "$frames" --out "$out/$3.png" > "$out/$3.txt"
}
value() { # report, metric
    sed -n "s/^| $2 | \([^|]*\) |.*/\1/p" "$out/$1/report.md" | head -1
}
decoded() {
    sed -n 's/^[^:]*: PSNR \([^,]*\), SSIM \([^ ]*\) .*/\1, \2/p' "$out/$1.txt" | head -1
}

one='data.train=[{ kind = "procedural", name = "six", seed = 1, scenes = 128, frames_per_scene = 8, rig = { preset = "nuscenes" } }]'
fisheye='data.train=[{ kind = "procedural", name = "five", seed = 4, scenes = 64, frames_per_scene = 8, rig = { preset = "wayve_scenes101" } }]'
for seed in $seeds; do
    learn "mixed-$seed" "$steps" --set "seed=$seed"
    learn "single-$seed" "$steps" --set "seed=$seed" --set "$one"
    learn "tuned-$seed" "$tune_steps" --set "seed=$seed" --set "$fisheye" --set optimizer.generator.learning_rate=1e-4 --init-from "$out/mixed-$seed"
    measure "mixed-$seed" six "six-mixed-$seed"
    measure "single-$seed" six "six-single-$seed"
    measure "mixed-$seed" five-fisheye "fisheye-zero-shot-$seed"
    measure "tuned-$seed" five-fisheye "fisheye-tuned-$seed"
    measure "mixed-$seed" six-without-front "six-without-front-$seed"
    decode "mixed-$seed" six "rig-argoverse2-$seed" argoverse2
    decode "mixed-$seed" six "rig-own-$seed" nuscenes
    decode "mixed-$seed" six-without-front "rig-own-without-front-$seed" nuscenes
done

{
    echo "$steps steps, fine-tuning $tune_steps steps; PSNR and SSIM of held-out scenes, EMA weights"
    echo
    echo "| claim | measured | $(for seed in $seeds; do printf 'seed %s | ' "$seed"; done)"
    echo "|---|---|$(for seed in $seeds; do printf -- '---|'; done)"
    row() { # claim, words, kind, name
        printf '| %s | %s |' "$1" "$2"
        for seed in $seeds; do
            case $3 in
            report) printf ' %s, %s |' "$(value "$4-$seed" psnr)" "$(value "$4-$seed" ssim)" ;;
            turned) printf ' %s |' "$(value "$4-$seed" 'yaw +30 deg')" ;;
            sheet) printf ' %s |' "$(decoded "$4-$seed")" ;;
            esac
        done
        echo
    }
    row a 'six cameras, trained on six cameras only' report six-single
    row a 'six cameras, trained on three rigs' report six-mixed
    row b 'five fisheye cameras, zero-shot' report fisheye-zero-shot
    row b 'five fisheye cameras, fine-tuned' report fisheye-tuned
    row c 'rig turned by +30 degrees' turned six-mixed
    row c 'seven cameras of another car from six' sheet rig-argoverse2
    row c 'six cameras from six' sheet rig-own
    row c 'six cameras from five, the front one hidden' sheet rig-own-without-front
    row c 'rig turned by +30 degrees, the front camera hidden' turned six-without-front
} | tee "$out/table.md"
