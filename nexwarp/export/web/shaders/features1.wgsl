// Rows of the hash grid with 1 feature an entry, in half precision.

alias Row = u32;
alias Features = f32;

fn fetch(index: u32) -> Features {
    let pair = unpack2x16float(grid[index / 2u]);
    return select(pair.x, pair.y, (index & 1u) == 1u);
}

fn store_features(x: ptr<function, array<Weight, INPUTS>>, level: u32, value: Features) {
    (*x)[level / 4u][level % 4u] = Scalar(value);
}
