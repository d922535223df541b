// Rows of the hash grid with 8 features an entry, in half precision.

alias Row = vec4u;
alias Features = mat2x4f;

fn fetch(index: u32) -> Features {
    let row = grid[index];
    return mat2x4f(
        vec4f(unpack2x16float(row.x), unpack2x16float(row.y)),
        vec4f(unpack2x16float(row.z), unpack2x16float(row.w)),
    );
}

fn store_features(x: ptr<function, array<Weight, INPUTS>>, level: u32, value: Features) {
    (*x)[2u * level] = Weight(value[0]);
    (*x)[2u * level + 1u] = Weight(value[1]);
}
