#include "patches.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "half.h"
#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kPatchesPerChunk = 16;
constexpr double kNearest = 1e-6;  // along the axis of a view: what lies before it is not seen

inline float number(uint16_t x) {
    return from_half(x);
}
template <class T>
inline T number(T x) {
    return x;
}

template <class T>
inline T dot(const T* a, const T* b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/// x - its mean, in place; its mean square afterwards.
template <class T>
T centre(T* x, int64_t n) {
    T sum = 0, square = 0;
    for (int64_t m = 0; m < n; ++m) sum += x[m];
    for (int64_t m = 0; m < n; ++m) {
        x[m] -= sum / n;
        square += x[m] * x[m];
    }
    return square / n;
}

/// The cell that a coordinate lies in, of n pixels: 0 for what is no number.
template <class T>
inline int64_t cell(T x, int64_t n) {
    return x > 0 ? (x < T(n - 2) ? int64_t(x) : n - 2) : 0;
}

/// A patch's plane as its own view sees it: 1 / depth along the axis, linear over the pixels.
template <class T>
struct Plane {
    T away;         // normal . (position - eye)
    T to[3];        // position - eye
    T nearness[3];  // in the middle; what a column, what a row adds
};

/// Of the M pixels of a patch.
template <class T>
struct Pixels {
    std::vector<T> own, other, along, nearness;  // along: d other / d nearness

    explicit Pixels(int64_t n) : own(n), other(n), along(n), nearness(n) {}
};

/// Look a patch up in another view; whether all that it shows there is brightness.
template <class T, class Stored>
bool look_up(const Patches<T>& in, const Stored* picture, const T* projection, const T* origin,
             const T* direction, const Plane<T>& plane, int64_t half, Pixels<T>& pixels) {
    T eye[3], step[3][3];  // homogeneous: of the eye, and of the directions
    for (int i = 0; i < 3; ++i) {
        eye[i] = dot(projection + 4 * i, origin) + projection[4 * i + 3];
        for (int j = 0; j < 3; ++j) step[j][i] = dot(projection + 4 * i, direction + 3 * j);
    }
    T least = 0;
    int64_t m = 0;
    for (int64_t row = -half; row <= half; ++row) {
        for (int64_t column = -half; column <= half; ++column, ++m) {
            const T c = T(column), r = T(row);
            const T near = plane.nearness[0] + c * plane.nearness[1] + r * plane.nearness[2];
            T at[3];
            for (int i = 0; i < 3; ++i) {
                at[i] = eye[i] * near + step[0][i] + c * step[1][i] + r * step[2][i];
            }
            const T inverse = at[2] > T(kNearest) ? 1 / at[2] : T(0);
            const T across = at[0] * inverse, down = at[1] * inverse;
            const int64_t x = cell(across - T(0.5), in.W), y = cell(down - T(0.5), in.H);
            const T u = across - T(0.5) - x, v = down - T(0.5) - y;
            const Stored* corner = picture + y * in.W + x;
            const T a = number(corner[0]), b = number(corner[1]);
            const T e = number(corner[in.W]), f = number(corner[in.W + 1]);
            least = std::min({least, a, b, e, f});
            const T twist = a - b - e + f;
            pixels.other[m] = a + u * (b - a) + v * (e - a) + u * v * twist;
            pixels.nearness[m] = near;
            pixels.along[m] = inverse * ((b - a + v * twist) * (eye[0] - across * eye[2]) +
                                         (e - a + u * twist) * (eye[1] - down * eye[2]));
        }
    }
    return least >= 0;
}

/// The correlation of a patch with what was looked up, and its gradient to position and normal.
template <class T>
T correlate(const T* direction, const T* normal, const Plane<T>& plane, int64_t half, T own_power,
            T noise, Pixels<T>& pixels, T* pulls) {
    const int64_t n = static_cast<int64_t>(pixels.own.size());
    const T power = centre(pixels.other.data(), n) + noise * noise;
    T both = 0;
    for (int64_t m = 0; m < n; ++m) both += pixels.own[m] * pixels.other[m];
    const T scale = 1 / std::sqrt(own_power * power), correlation = both / n * scale;
    T sum = 0, by_column = 0, by_row = 0, by_nearness = 0;
    int64_t m = 0;
    for (int64_t row = -half; row <= half; ++row) {
        for (int64_t column = -half; column <= half; ++column, ++m) {
            const T to_other = scale * pixels.own[m] - correlation / power * pixels.other[m];
            const T g = to_other / n * pixels.along[m];
            sum += g, by_column += column * g, by_row += row * g;
            by_nearness += pixels.nearness[m] * g;
        }
    }
    for (int i = 0; i < 3; ++i) {
        const T steps =
            sum * direction[i] + by_column * direction[3 + i] + by_row * direction[6 + i];
        pulls[i] = -by_nearness * normal[i] / plane.away;
        pulls[3 + i] = (steps - by_nearness * plane.to[i]) / plane.away;
    }
    return correlation;
}

template <class T, class Stored>
void compare(const Patches<T>& in, const Stored* brightness, const PatchResult<T>& out, T noise,
             int threads) {
    const int64_t half = (std::llround(std::sqrt(double(in.M))) - 1) / 2;
    parallel_for(in.N, kPatchesPerChunk, threads, [&](int64_t begin, int64_t end) {
        Pixels<T> pixels(in.M);
        for (int64_t n = begin; n < end; ++n) {
            const T *origin = in.origin + 3 * n, *direction = in.direction + 9 * n;
            const T* normal = in.normal + 3 * n;
            std::copy(in.own + in.M * n, in.own + in.M * (n + 1), pixels.own.begin());
            const T own_power = centre(pixels.own.data(), in.M) + noise * noise;
            Plane<T> plane;
            for (int i = 0; i < 3; ++i) plane.to[i] = in.position[3 * n + i] - origin[i];
            plane.away = dot(normal, plane.to);
            for (int j = 0; j < 3; ++j) {
                plane.nearness[j] = dot(normal, direction + 3 * j) / plane.away;
            }
            for (int64_t k = in.K * n; k < in.K * (n + 1); ++k) {
                const int64_t view = in.views[k];
                out.seen[k] =
                    look_up(in, brightness + view * in.H * in.W, in.projection + 12 * view, origin,
                            direction, plane, half, pixels);
                out.correlation[k] = correlate(direction, normal, plane, half, own_power, noise,
                                               pixels, out.pulls + 6 * k);
            }
        }
    });
}

}  // namespace

template <class T>
void patch_correlation(const Patches<T>& in, const PatchResult<T>& out, T noise, int threads) {
    std::visit([&](const auto* brightness) { compare(in, brightness, out, noise, threads); },
               in.brightness);
}

template void patch_correlation(const Patches<float>&, const PatchResult<float>&, float, int);
template void patch_correlation(const Patches<double>&, const PatchResult<double>&, double, int);

}  // namespace univoxel
