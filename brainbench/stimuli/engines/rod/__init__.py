"""Our own whisker solver in Warp: implicit, O(links), rigid contact with exact surfaces, on CPU and GPU.

Jobs of scenes (:mod:`.engine`) and of sweeps (:mod:`.sweeps`) are packed into arrays (:mod:`.packing`), launched,
judged and tried again (:mod:`.launch`); on a GPU the kernels take turns (:mod:`.slices`).
"""
