// What Embree does at best: shadow rays in a bare loop, for benchmarks/peers.py and relight_rays.py
// (C ABI, ctypes).
#include <algorithm>
#include <cstdint>
#include <limits>
#if UNIVOXEL_EMBREE >= 4
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

extern "C" {

/// A committed scene over vertices [n_vertices, 3] and faces [n_faces, 3], copied.
__attribute__((visibility("default"))) void* bare_scene(const float* vertices, int64_t n_vertices,
                                                        const int32_t* faces, int64_t n_faces,
                                                        int robust) {
    RTCDevice device = rtcNewDevice(nullptr);
    RTCScene scene = rtcNewScene(device);
    if (robust) rtcSetSceneFlags(scene, RTC_SCENE_FLAG_ROBUST);
    RTCGeometry mesh = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
    float* v = static_cast<float*>(rtcSetNewGeometryBuffer(
        mesh, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 3 * sizeof(float), n_vertices));
    uint32_t* f = static_cast<uint32_t*>(rtcSetNewGeometryBuffer(
        mesh, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 3 * sizeof(uint32_t), n_faces));
    for (int64_t i = 0; i < 3 * n_vertices; ++i) v[i] = vertices[i];
    for (int64_t i = 0; i < 3 * n_faces; ++i) f[i] = static_cast<uint32_t>(faces[i]);
    rtcCommitGeometry(mesh);
    rtcAttachGeometry(scene, mesh);
    rtcReleaseGeometry(mesh);
    rtcCommitScene(scene);
    return scene;
}

/// out [n] = whether something lies along each ray, origin and direction [n, 3].
__attribute__((visibility("default"))) void bare_occluded(void* scene, const float* origin,
                                                          const float* direction, int64_t n,
                                                          bool* out, int threads) {
#pragma omp parallel for schedule(dynamic, 1024) num_threads(threads)
    for (int64_t i = 0; i < n; ++i) {
        RTCRay ray;
        ray.org_x = origin[3 * i], ray.org_y = origin[3 * i + 1], ray.org_z = origin[3 * i + 2];
        ray.dir_x = direction[3 * i], ray.dir_y = direction[3 * i + 1];
        ray.dir_z = direction[3 * i + 2];
        ray.tnear = 0, ray.tfar = std::numeric_limits<float>::infinity();
        ray.time = 0, ray.mask = ~0u, ray.id = 0, ray.flags = 0;
#if UNIVOXEL_EMBREE >= 4
        rtcOccluded1(static_cast<RTCScene>(scene), &ray);
#else
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        rtcOccluded1(static_cast<RTCScene>(scene), &context, &ray);
#endif
        out[i] = ray.tfar < 0;
    }
}

/// The same by packets of 8 neighbours.
__attribute__((visibility("default"))) void bare_occluded_8(void* scene, const float* origin,
                                                            const float* direction, int64_t n,
                                                            bool* out, int threads) {
#pragma omp parallel for schedule(dynamic, 128) num_threads(threads)
    for (int64_t first = 0; first < n; first += 8) {
        alignas(32) int valid[8];
        RTCRay8 ray;
        for (int64_t k = 0; k < 8; ++k) {
            const int64_t i = std::min(first + k, n - 1);
            valid[k] = first + k < n ? -1 : 0;
            ray.org_x[k] = origin[3 * i], ray.org_y[k] = origin[3 * i + 1];
            ray.org_z[k] = origin[3 * i + 2];
            ray.dir_x[k] = direction[3 * i], ray.dir_y[k] = direction[3 * i + 1];
            ray.dir_z[k] = direction[3 * i + 2];
            ray.tnear[k] = 0, ray.tfar[k] = std::numeric_limits<float>::infinity();
            ray.time[k] = 0, ray.mask[k] = ~0u, ray.id[k] = 0, ray.flags[k] = 0;
        }
#if UNIVOXEL_EMBREE >= 4
        rtcOccluded8(valid, static_cast<RTCScene>(scene), &ray);
#else
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        rtcOccluded8(valid, static_cast<RTCScene>(scene), &context, &ray);
#endif
        for (int64_t k = 0; k < std::min<int64_t>(8, n - first); ++k)
            out[first + k] = ray.tfar[k] < 0;
    }
}
}
