// Exclusive prefix sums of u32 in place: `reduce` sums blocks of 1024, `middle` (one workgroup) scans those sums and
// writes the total behind them, `spread` scans each block.

struct Scan {
    count: u32,
    blocks: u32,
    unused0: u32,
    unused1: u32,
}

@group(0) @binding(0) var<uniform> scan: Scan;
@group(0) @binding(1) var<storage, read_write> data: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;

var<workgroup> shared_sums: array<u32, 256>;

// Exclusive prefix sum over the 256 threads; `shared_sums[255]` becomes the total.
fn scan_threads(lane: u32, value: u32) -> u32 {
    shared_sums[lane] = value;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        var before = 0u;
        if (lane >= step) {
            before = shared_sums[lane - step];
        }
        workgroupBarrier();
        shared_sums[lane] += before;
        workgroupBarrier();
    }
    return shared_sums[lane] - value;
}

fn read(i: u32) -> u32 {
    if (i < scan.count) {
        return data[i];
    }
    return 0u;
}

@compute @workgroup_size(256)
fn reduce(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group.y * groups.x + group.x;
    let i = block * 1024u + lane * 4u;
    shared_sums[lane] = read(i) + read(i + 1u) + read(i + 2u) + read(i + 3u);
    workgroupBarrier();
    for (var half = 128u; half > 0u; half /= 2u) {
        if (lane < half) {
            shared_sums[lane] += shared_sums[lane + half];
        }
        workgroupBarrier();
    }
    if (lane == 0u && block < scan.blocks) {
        sums[block] = shared_sums[0];
    }
}

@compute @workgroup_size(256)
fn middle(@builtin(local_invocation_index) lane: u32) {
    var carry = 0u;
    for (var start = 0u; start < scan.blocks; start += 256u) {
        let i = start + lane;
        var value = 0u;
        if (i < scan.blocks) {
            value = sums[i];
        }
        let before = scan_threads(lane, value);
        if (i < scan.blocks) {
            sums[i] = carry + before;
        }
        carry += shared_sums[255];
        workgroupBarrier();
    }
    if (lane == 0u) {
        sums[scan.blocks] = carry;
    }
}

@compute @workgroup_size(256)
fn spread(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group.y * groups.x + group.x;
    let i = block * 1024u + lane * 4u;
    let values = vec4u(read(i), read(i + 1u), read(i + 2u), read(i + 3u));
    var before = scan_threads(lane, values.x + values.y + values.z + values.w);
    if (block < scan.blocks) {
        before += sums[block];
        for (var k = 0u; k < 4u; k++) {
            if (i + k < scan.count) {
                data[i + k] = before;
            }
            before += values[k];
        }
    }
}
