"""Quality on real scenes: nexwarp beside gsplat's 3DGS-MCMC, the paper's ablations, the effect of each of our changes.

    python -m benchmarks.quality train --tables peers,hits --data DIR --out results.jsonl
    python -m benchmarks.quality table results.jsonl --out quality.md --json quality.json
    python -m benchmarks.quality curve results.jsonl --scene fox --out curve.png
    python -m benchmarks.quality publish results.jsonl --commit HASH --page docs/quality.md
    python -m benchmarks.quality.spread results.jsonl --seconds 800 --data DIR
    python -m benchmarks.quality.equal_seconds results.jsonl --data DIR
    python -m benchmarks.quality train --tables demo --seeds 0 --pictures DIR --out demo.jsonl
    python -m benchmarks.quality train --tables changes --variant inner --out inner.jsonl

`--variant inner` holds out every 8th training photo in place of the test views, to choose settings by; `half`, `third`
and `fifth` do that, too, and train on a part of the other photos.
`train` appends one JSON line per training and skips the trainings that the file already holds: it can be stopped and
resumed, and run on several machines. Rows that differ only in K or in how a model is finished train alike until K
takes effect (`more_hits_from`); until there they share one training. The table `demo` needs no data: it holds out
neighbouring cameras of the built-in scene and takes minutes on a CPU. `table` makes Markdown of the results: means and
spreads over seeds, and the difference of each row from the default, or from the row `--against`, averaged over the
scenes. Two tables never train the same job twice. `curve` draws a metric over the number of primitives. `publish` fills
the marked blocks of the documents with results of one commit of the default, says "not run" where there is none, and
refuses results of other commits or settings.

Metrics are those of `nexwarp.run.metrics`; LPIPS needs the weights of VGG and is left out where they cannot be had.
Speed and memory of a training count only when it ran alone (`--jobs 1`).

Two names are those of older versions, because kept results refer to them: the table and the variant `arc` (held-out
arc), and the row "no footprints" (detail limits).
"""
