// From signed distances to opacity: NeuS (Wang et al. 2021), eq. 13.
#pragma once

#include <algorithm>
#include <cmath>

namespace univoxel {

/// Opacity of a section from its sdf over s at start and end:
///   max(0, 1 - sigmoid(end) / sigmoid(start)) = max(0, 1 - exp(end - start)) / (1 + exp(end))
/// which neither cancels nor overflows, however deep inside.
template <class T>
T section_alpha(T start, T end) {
    if (end >= start) return 0;
    return -std::expm1(end - start) / (1 + std::exp(end));  // an infinite divisor gives 0
}

/// Its derivatives to both; 0 where it is.
template <class T>
struct AlphaSlope {
    T start, end;
};

template <class T>
AlphaSlope<T> section_alpha_slope(T start, T end) {
    if (end >= start) return {0, 0};
    const T kept = std::exp(end - start), outside = 1 / (1 + std::exp(end));
    const T to_start = kept * outside;
    return {to_start, -to_start - outside * (1 - kept) * (1 - outside)};
}

}  // namespace univoxel
