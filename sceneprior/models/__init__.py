"""The paper's network, sections 3.1 to 3.3: `prior` puts the other modules together.

Symbols of the paper, here and in `losses`: z a latent, w_i the weights of its anchors phi_i, x_k
the feature of the k-th object and F_k the scene context it is generated from; l_k, c_k, s_k, p_k
an object's class, box centre, box size and completeness, S_k its vertices; N objects; D_z the
`width`.
"""
