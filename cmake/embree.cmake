# Embree 4 or 3, or none: a build without it says what is missing when visibility is asked for.
add_library(univoxel_embree INTERFACE)
find_package(embree 4 CONFIG QUIET)
if(NOT embree_FOUND)
    find_package(embree 3 CONFIG QUIET)
endif()
if(embree_FOUND)
    message(STATUS "Embree ${embree_VERSION}: visibility rays are available")
    target_link_libraries(univoxel_embree INTERFACE embree)
    target_compile_definitions(univoxel_embree INTERFACE
        UNIVOXEL_EMBREE=${embree_VERSION_MAJOR})
else()
    message(STATUS "Embree not found: building without visibility rays "
                   "(Debian: apt-get install libembree-dev)")
endif()
