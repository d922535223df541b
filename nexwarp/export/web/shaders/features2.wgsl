// Rows of the hash grid with 2 features an entry, in half precision.

alias Row = u32;
alias Features = vec2f;

fn fetch(index: u32) -> Features {
    return unpack2x16float(grid[index]);
}

fn store_features(x: ptr<function, array<Weight, INPUTS>>, level: u32, value: Features) {
    if (level % 2u == 0u) {
        (*x)[level / 2u] = Weight(vec4f(value, 0.0, 0.0));
    } else {
        (*x)[level / 2u] = Weight(vec4f(vec2f((*x)[level / 2u].xy), value));
    }
}
