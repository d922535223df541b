// Rows of the hash grid with 4 features an entry, in half precision.

alias Row = vec2u;
alias Features = vec4f;

fn fetch(index: u32) -> Features {
    let row = grid[index];
    return vec4f(unpack2x16float(row.x), unpack2x16float(row.y));
}

fn store_features(x: ptr<function, array<Weight, INPUTS>>, level: u32, value: Features) {
    (*x)[level] = Weight(value);
}
