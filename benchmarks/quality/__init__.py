"""Quality on real scenes: nexwarp beside gsplat's 3DGS and 2DGS.

    python -m benchmarks.quality train --tables peers --data DIR --out results.jsonl
    python -m benchmarks.quality train --row 'K = 4:default:{"max_hits": 4}' --variant inner --out trial.jsonl
    python -m benchmarks.quality train --tables peers --seeds 0 --curve --out curves.jsonl
    python -m benchmarks.quality curves curves.jsonl --out curves.png
    python -m benchmarks.quality table results.jsonl
    python -m benchmarks.quality publish results.jsonl --page docs/quality.md --page README.md

`train` appends one JSON line per training and skips the trainings that the file already holds, so it can be stopped and
resumed. `--variant inner` holds out every 8th training photo in place of the test views, to choose settings by.
`--curve` adds the quality at times of the training, which `curves` draws. `table` prints means over seeds. `publish`
fills the marked blocks of the documents.

Metrics are those of `nexwarp.run.evaluate`; LPIPS needs the weights of VGG and is left out where they cannot be had.
Speed and memory of a training count only when it ran alone (`--jobs 1`).
"""
