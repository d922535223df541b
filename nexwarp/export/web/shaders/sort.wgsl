// Stable radix sort of (key, value) pairs, eight bits a pass: `histogram`, prefix sums (scan.wgsl), `scatter`.
//
// A workgroup takes a block of 2048 pairs, 256 at a time. The rank of a pair among those of its digit is the number of
// set bits before its own in that digit's mask of the 256 threads.

struct Sort {
    shift: u32,
    blocks: u32,
    count: u32,
    total: u32,  // index in `totals` of another upper limit of the count
}

@group(0) @binding(0) var<uniform> sort: Sort;
@group(0) @binding(1) var<storage, read> totals: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;  // by digit, then block
@group(0) @binding(5) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> sorted_values: array<u32>;

const ROUNDS: u32 = 8u;

var<workgroup> digits: array<atomic<u32>, 256>;
var<workgroup> masks: array<atomic<u32>, 2048>;  // 8 words for each of 256 digits
var<workgroup> starts: array<u32, 256>;

fn count() -> u32 {
    return min(sort.count, totals[sort.total]);
}

@compute @workgroup_size(256)
fn histogram(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group.y * groups.x + group.x;
    atomicStore(&digits[lane], 0u);
    workgroupBarrier();
    let end = count();
    for (var round = 0u; round < ROUNDS; round++) {
        let i = (block * ROUNDS + round) * 256u + lane;
        if (i < end) {
            atomicAdd(&digits[(keys[i] >> sort.shift) & 255u], 1u);
        }
    }
    workgroupBarrier();
    if (block < sort.blocks) {
        counts[lane * sort.blocks + block] = atomicLoad(&digits[lane]);
    }
}

@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group.y * groups.x + group.x;
    let end = count();
    starts[lane] = 0u;
    if (block < sort.blocks) {
        starts[lane] = counts[lane * sort.blocks + block];
    }
    let word = lane / 32u;
    let bit = 1u << (lane % 32u);
    for (var round = 0u; round < ROUNDS; round++) {
        let i = (block * ROUNDS + round) * 256u + lane;
        for (var k = 0u; k < 8u; k++) {
            atomicStore(&masks[k * 256u + lane], 0u);
        }
        workgroupBarrier();
        var key = 0u;
        var digit = 0u;
        if (i < end) {
            key = keys[i];
            digit = (key >> sort.shift) & 255u;
            atomicOr(&masks[digit * 8u + word], bit);
        }
        workgroupBarrier();
        if (i < end) {
            var rank = countOneBits(atomicLoad(&masks[digit * 8u + word]) & (bit - 1u));
            for (var k = 0u; k < word; k++) {
                rank += countOneBits(atomicLoad(&masks[digit * 8u + k]));
            }
            let place = starts[digit] + rank;
            sorted_keys[place] = key;
            sorted_values[place] = values[i];
        }
        workgroupBarrier();
        var found = 0u;
        for (var k = 0u; k < 8u; k++) {
            found += countOneBits(atomicLoad(&masks[lane * 8u + k]));
        }
        starts[lane] += found;
        workgroupBarrier();
    }
}
