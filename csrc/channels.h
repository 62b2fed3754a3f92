// Loops over channels whose count the compiler knows.
#pragma once

#include <cstdint>
#include <type_traits>

namespace univoxel {

/// Call f with the channel count as a compile-time constant where it is a common one, else 0.
template <class F>
void with_channels(int64_t n, F&& f) {
    switch (n) {
        case 1:
            return f(std::integral_constant<int64_t, 1>{});
        case 8:
            return f(std::integral_constant<int64_t, 8>{});
        case 12:
            return f(std::integral_constant<int64_t, 12>{});
        case 16:
            return f(std::integral_constant<int64_t, 16>{});
        default:
            return f(std::integral_constant<int64_t, 0>{});
    }
}

}  // namespace univoxel
